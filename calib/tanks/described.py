"""Frames alone, of NumPy, a table of text or a MATLAB file, as readings of a tank that a skin describes."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import jaxeit as je

from .archives import archive_tank, read_archive
from .matlab import columns_of, forward_models, is_ktc, named_frames, read_matlab, stimulation_protocol
from .recording import Tank, TankError
from .texts import read_table

LISTED = 8
"""Variables that an error names."""


def described_tank(path: Path, skin: je.Skin) -> Tank:
    """The frames of a file without a tank.

    Of NumPy, each array of one or two axes, one of which has as many readings as the protocol; of a table, its rows or
    its columns. Of a MATLAB file, each array with a column a frame, or a data structure with one, whose readings are
    those of the protocol; the protocol is that of a ``stimulation`` in the file, and of the skin where there is none. A
    column of all pairs of neighbours for every drive of neighbours, as EIDORS fills one, is read by the rows of the
    protocol.

    Raises:
        TankError: if the file has a tank or a scan of its own, or no variable has the readings of the protocol.
    """
    kind = path.suffix.lower()
    if kind == ".mat":
        return _of_matlab(path, read_matlab(path), skin)
    if kind in (".csv", ".txt"):
        return _of_table(path, *read_table(path), skin)
    arrays = read_archive(path) if kind in (".npz", ".npy") else {}
    if not arrays or not {"pattern", "current"}.isdisjoint(arrays):
        raise TankError(
            f"{path.name}: a file of frames that a skin's TOML describes is an .npz, .npy, .csv or .mat of readings "
            "alone; other files have a scan of their own: leave the skin out"
        )
    if set(arrays) == {"frames"}:
        return archive_tank(skin, arrays["frames"])
    frames = {name: found for name, array in arrays.items() if (found := _columns(array, skin)) is not None}
    if not frames:
        raise _without_readings(path, arrays, skin)
    return named_frames(skin, frames)


def _of_table(path: Path, names: tuple[str, ...], table: np.ndarray, skin: je.Skin) -> Tank:
    """A table with a frame in each row, or in each column by its name."""
    readings = skin.protocol.readings
    if table.shape[1] != readings and len(table) == readings:
        return named_frames(skin, dict(zip(names, np.hsplit(table, table.shape[1]), strict=True)))
    if table.shape[1] != readings:
        raise _without_readings(path, {"a table": table}, skin)
    return archive_tank(skin, table)


def _columns(array: np.ndarray, skin: je.Skin) -> np.ndarray | None:
    """An array as (readings, frames); None if no axis has the readings of the protocol."""
    if array.dtype.kind not in "fiuc" or array.ndim not in (1, 2):
        return None
    if array.shape[-1] == skin.protocol.readings:
        return np.atleast_2d(array).T
    return array if array.ndim == 2 and len(array) == skin.protocol.readings else None


def _without_readings(
    path: Path, arrays: Mapping[str, np.ndarray], skin: je.Skin, whose: str = "the skin"
) -> TankError:
    """What a file holds, where nothing in it has the readings of the protocol."""
    sizes = [f"{name} {' x '.join(map(str, found.shape))}" for name, found in arrays.items()]
    held = ", ".join(sizes[:LISTED]) + (", ..." if len(sizes) > LISTED else "") or "no numbers"
    return TankError(
        f"{path.name}: holds {held}; the protocol of {whose} has {skin.protocol.readings} readings of "
        f"{len(skin.electrodes)} electrodes: give the protocol of these readings, or save them as columns of as many "
        "rows"
    )


def _of_matlab(path: Path, variables: Mapping[str, Any], skin: je.Skin) -> Tank:
    if is_ktc(variables) or next(forward_models(variables), None) is not None:
        raise TankError(f"{path.name}: has a tank of its own; leave the skin out")
    electrodes, whose = len(skin.electrodes), "the skin"
    for name, holder in _stimulations(variables):
        protocol = stimulation_protocol(f"{path.name}: {name}", holder, electrodes)
        skin, whose = replace(skin, protocol=protocol), f"{name}"
    columns = {name: found for name, value in variables.items() if (found := columns_of(value)) is not None}
    frames = {
        name: chosen
        for name, found in columns.items()
        if (chosen := _readings_of(found, skin.protocol, electrodes)) is not None
    }
    if not frames:
        raise _without_readings(path, columns, skin, whose)
    return named_frames(skin, frames)


def _stimulations(variables: Mapping[str, Any]) -> Iterator[tuple[str, SimpleNamespace]]:
    """What has a field ``stimulation``, and variables that are one themselves, by name."""
    for name, value in variables.items():
        first = value[0] if isinstance(value, list) and value else value
        if hasattr(first, "stim_pattern"):
            yield name, SimpleNamespace(stimulation=value)
        elif hasattr(value, "stimulation"):
            yield f"{name}.stimulation", value


def _readings_of(columns: np.ndarray, protocol: je.Protocol, electrodes: int) -> np.ndarray | None:
    """The columns of a variable as readings of the protocol, (readings, frames), if they can be that."""
    if len(columns) == protocol.readings:
        return columns
    if len(columns) != electrodes**2 or protocol.mixing is not None:
        return None
    (drive, turned), (sense, sign) = (_neighbours(pair, electrodes) for pair in np.split(protocol.pattern, 2, 1))
    if (turned * sign == 0).any():
        return None
    chosen: np.ndarray = (-turned * sign)[:, None] * columns[electrodes * drive + sense]
    return chosen


def _neighbours(pairs: np.ndarray, electrodes: int) -> tuple[np.ndarray, np.ndarray]:
    """For pairs (m, m + 1), m and 1; for pairs (m + 1, m), m and -1; a sign of 0 for others.

    In EIDORS the current of drive d enters at electrode d + 1, and pair m is read as m less m + 1.
    """
    first, second = pairs.T
    forward, backward = ((there - here) % electrodes == 1 for here, there in ((first, second), (second, first)))
    return np.where(forward, first, second), np.where(forward, 1, np.where(backward, -1, 0))
