"""Arrays of a calibration file, checked."""

from collections.abc import Mapping

import numpy as np


def shaped(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], kinds: str) -> np.ndarray:
    """The named array; raises ValueError unless it has this shape and one of these kinds of type."""
    array = arrays[name]
    if array.shape != shape or array.dtype.kind not in kinds or array.dtype == np.float16:
        raise ValueError(f"{name} is {array.dtype} of shape {array.shape}, not numbers of shape {shape}")
    return array
