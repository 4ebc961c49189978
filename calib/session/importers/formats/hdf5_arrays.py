"""Datasets of foreign HDF5 files. This module runs in a child process, because the library trusts sizes in a file."""

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from ...errors import problem
from ..arrays import ArrayShape, table_values
from ..limits import MAX_NAMES

MAX_DEPTH = 8


def members(path: Path, group: h5py.Group) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Members that are hard links, so that no other file is opened; refused if there are too many."""
    if len(group) > MAX_NAMES:
        raise problem(path, group.name, f"has {len(group):,} members", "name another file")
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield name, group[name]


def datasets(
    path: Path, group: h5py.Group, separator: str, prefix: str = "", depth: int = 0
) -> Iterator[tuple[str, h5py.Dataset]]:
    """Numeric datasets by path, whose data lie in the file itself."""
    for name, member in members(path, group):
        where = f"{prefix}{name}"
        if isinstance(member, h5py.Group):
            if depth < MAX_DEPTH and not name.startswith("#"):  # of MATLAB's own
                yield from datasets(path, member, separator, where + separator, depth + 1)
        elif isinstance(member, h5py.Dataset) and member.dtype.kind in "biuf" and data_inside(member):
            yield where, member


def data_inside(dataset: h5py.Dataset) -> bool:
    """Whether the data of a dataset are in the file itself, not in other files."""
    return dataset.external is None and not dataset.is_virtual and dataset.shape is not None


def values_of(path: Path, dataset: h5py.Dataset, shape: ArrayShape, transposed: bool = False) -> np.ndarray:
    """A dataset as (rows, columns) float64."""
    values = dataset[()]
    return table_values(values.T if transposed else values, shape)
