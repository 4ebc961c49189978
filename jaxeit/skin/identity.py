"""Whether two descriptions are those of the same skin."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from .description import Skin
from .protocol import Protocol

SIGNIFICANT_DIGITS = 12  # of numbers: the places of a grid and those of a list differ in the last digits
NO_HARDWARE = ("name", "toml")  # fields of skins and pads


def skin_hash(skin: Skin) -> str:
    """SHA-256 of a skin as it was read: sheet, surface, electrodes, protocol, pads and pressure sensors.

    Names, comments, the order of keys and the way in which numbers are written do not count. Electrodes on a grid have
    the same hash as the same electrodes in a list.

    Example:
        # session and calibration files name their skin so
        print(je.skin.skin_hash(je.load_skin("testbed"))[:12])
    """
    text = json.dumps(_plain(skin), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """A part of a skin as JSON holds it; numbers as texts of so many digits."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, int | float | np.number):
        return f"{float(value) + 0.0:.{SIGNIFICANT_DIGITS}g}"  # + 0.0: minus zero is zero
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, sp.sparray | sp.spmatrix):
        coo = sp.coo_array(sp.csr_array(value))
        return [_plain(part) for part in (coo.shape, coo.row, coo.col, coo.data)]
    if isinstance(value, Sequence):
        return [_plain(part) for part in value]
    names = [each.name for each in fields(value)] if is_dataclass(value) else list(vars(value))
    plain = {name: _plain(getattr(value, name)) for name in names if name not in NO_HARDWARE}
    if isinstance(value, Protocol) and value.sense_channels == 1:  # as before there were several
        del plain["sense_channels"]
    return [type(value).__name__, plain]
