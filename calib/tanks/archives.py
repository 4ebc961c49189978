"""NumPy archives of frames."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

import jaxeit as je
from jaxeit.files import open_regular

from .recording import Tank, TankError


def archive_tank(skin: je.Skin, frames: np.ndarray) -> Tank:
    """Frames (frames, readings), or one of them, that may be complex."""
    frames = np.atleast_2d(frames)
    quadrature = frames.imag if np.iscomplexobj(frames) else None
    names = tuple(f"frame {k}" for k in range(len(frames)))
    return Tank(skin, frames.real.astype(float), names, quadrature)


def read_archive(path: Path) -> dict[str, Any]:
    """The arrays of an .npz by name; that of an .npy is ``frames``."""
    try:
        if path.suffix.lower() == ".npy":
            with open_regular(path) as file:
                return {"frames": np.load(file, allow_pickle=False)}
        with open_regular(path) as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (ValueError, zipfile.BadZipFile, EOFError, KeyError) as error:
        raise TankError(f"{path.name}: cannot be read as a NumPy archive: {error}") from None
