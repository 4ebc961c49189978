"""HDF5 files that were not written by this program: tables of arrays, and sessions written by h5py or MATLAB.

`calib.session` opens files of the current HDF5 layout with checksums, fixed-length texts and plain numbers only. A
session that h5py or MATLAB wrote with default settings is not such a file, and is converted here, in a child process.
"""

import argparse
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from ...errors import printable, problem
from ...hdf5.datasets import AttributeValue, make_array, make_dataset, make_group, put_attributes, text_array
from ...hdf5.new_files import new_file
from ...outputs import replacing, writing
from ...reader import Session, open_session
from ...tables import SESSION_FORMAT, STREAM_EXTRAS
from ..arrays import AbstractArrayImporter, ArrayShape, known, table_shape
from ..base import StatedFacts
from ..child import in_child
from ..reports import FileReport, ImportReport, StreamReport
from ..tables.table import first_bytes
from .hdf5_arrays import MAX_DEPTH, data_inside, datasets, members, values_of

MAX_BYTES = 16 << 30
"""Largest total size in bytes of the arrays of a session to convert."""
MAX_TEXTS = 1 << 20
"""Largest number of texts in one array."""
BLOCK_BYTES = 16 << 20
MAX_RANK = 4
VECTORS = {"time", "status", *STREAM_EXTRAS}
TABLES = {"presses", "events", "clocks"}
SCALES = ("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "DIMENSION_LABELS", "_Netcdf4", "_NC", "MATLAB_")
"""Attributes (by their beginnings) that describe dimension scales, or belong to another program."""


class Hdf5Importer(AbstractArrayImporter):
    """Datasets as columns, named by their path: ``run1/force``; or, without --stream, a session in an older layout."""

    name: ClassVar[str] = "hdf5"
    summary: ClassVar[str] = "HDF5 of h5py or MATLAB: arrays, or (without --stream) a session in an older layout"

    @classmethod
    def outline(cls, path: Path) -> dict[str, ArrayShape]:
        """See `AbstractArrayImporter.outline`."""
        with _opened(path) as file:
            shapes = {name: table_shape(dataset.shape) for name, dataset in datasets(path, file, "/")}
        return {name: shape for name, shape in shapes.items() if shape is not None}

    @classmethod
    def arrays(cls, path: Path, names: Sequence[str]) -> list[np.ndarray]:
        """See `AbstractArrayImporter.arrays`."""
        with _opened(path) as file:
            found = dict(datasets(path, file, "/"))
            picked = [known(path, found, name) for name in names]
            return [values_of(path, dataset, ArrayShape(*table_shape(dataset.shape) or (0, 1))) for dataset in picked]

    @classmethod
    def convert(cls, args: argparse.Namespace, output: Path, about: StatedFacts) -> ImportReport:
        """See `AbstractImporter.convert`."""
        (group, *more) = args.groups
        if any((more, group.paths[1:], group.streams, group.time, group.rate)):
            return super().convert(args, output, about)
        return convert_session(Path(group.paths[0]), output)

    @classmethod
    def copy_session(cls, path: Path, folder: Path) -> list[str]:
        """Copy the session ``path`` to ``folder/path.name``; returns the names of members that were left out."""
        with _opened(path) as file:
            said = file.attrs.get("format", "")
            if _text(said) != SESSION_FORMAT:
                what = "is HDF5 but not a session"
                raise problem(path, "file", what, "say which arrays are what with --time and --stream")
            with new_file(folder / path.name) as (target, check):
                copy = _Copy(path)
                copy.group(file, target)
                check()
                return copy.left_out


def convert_session(path: Path, output: Path) -> ImportReport:
    """Convert a session from an older HDF5 layout to the one that this program reads; raises `SessionError`."""
    with tempfile.TemporaryDirectory() as folder:
        left_out = in_child(Hdf5Importer, "copy_session", path, folder=Path(folder))
        made = Path(folder) / path.name
        with open_session(made) as session:
            report = _report(path, output, session, left_out)
        with writing(output), replacing(output, session=True) as temporary:
            shutil.copyfile(made, temporary)
    return report


def _report(path: Path, output: Path, session: Session, left_out: Sequence[str]) -> ImportReport:
    streams = tuple(
        StreamReport(s.name, s.variable, s.unit, len(s), s.channels, s.nominal_rate, 0, 0, None, ())
        for s in session.streams.values()
    )
    rows = sum(len(stream) for stream in session.streams.values())
    file = FileReport(path, rows, 0, None, 0, None, 0, streams)
    notes = tuple(f"{printable(name)} was left out: not plain numbers or texts in this file" for name in left_out)
    return ImportReport(output, datetime.fromisoformat(session.epoch), True, (file,), notes)


# --- in the child --------------------------------------------------------------------------------


def _opened(path: Path) -> h5py.File:
    if not first_bytes(path):
        raise problem(path, "file", "is empty", "take another copy")
    return h5py.File(path, "r")


class _Copy:
    """Copies groups, attributes and datasets in a form that this program reads, and lists those that it leaves out."""

    def __init__(self, path: Path):
        self._path = path
        self._bytes = 0
        self.left_out: list[str] = []

    def group(self, source: h5py.Group, target: h5py.Group, depth: int = 0) -> None:
        """Copy a group and all below it."""
        put_attributes(target, dict(_attributes(source)))
        there = dict(members(self._path, source))
        self.left_out += [f"{source.name.rstrip('/')}/{name}" for name in source if name not in there]
        for name, member in there.items():
            if isinstance(member, h5py.Group) and depth < MAX_DEPTH:
                self.group(member, make_group(target, name, {}), depth + 1)
            elif isinstance(member, h5py.Dataset) and self._can_copy(member):
                self._dataset(member, target, name)
            else:
                self.left_out.append(member.name)

    def _can_copy(self, source: h5py.Dataset) -> bool:
        plain = source.dtype.kind in "biufS" or h5py.check_string_dtype(source.dtype) is not None
        return plain and data_inside(source) and source.ndim <= MAX_RANK

    def _dataset(self, source: h5py.Dataset, target: h5py.Group, name: str) -> None:
        self._bytes += source.size * max(1, source.dtype.itemsize)
        if self._bytes > MAX_BYTES:
            what = f"arrays claim more than {MAX_BYTES:,} bytes"
            raise problem(self._path, source.name, what, "split the recording into shorter sessions")
        attributes = dict(_attributes(source))
        if source.dtype.kind not in "biuf":
            if source.size > MAX_TEXTS:
                raise problem(self._path, source.name, f"holds {source.size:,} texts", "name another file")
            texts = text_array([_text(value) for value in np.ravel(source[()])])
            make_array(target, name, texts.reshape(_shape(source)), attributes)
        elif not source.size or not source.shape:
            make_array(target, name, np.asarray(source[()]).astype(_kind(source)).reshape(_shape(source)), attributes)
        else:
            made = make_dataset(target, name, _shape(source), _kind(source))
            _copy_rows(source, made)
            put_attributes(made, attributes)


def _copy_rows(source: h5py.Dataset, target: h5py.Dataset) -> None:
    """Copy in bounded pieces; a single row of a vector may lie along the second axis."""
    along = int(source.ndim == 2 and target.ndim == 1 and source.shape[0] == 1)
    step = max(1, BLOCK_BYTES * source.shape[along] // max(1, source.size * source.dtype.itemsize))
    for start in range(0, source.shape[along], step):
        rows = slice(start, start + step)
        block = source[:, rows] if along else source[rows]
        target[rows] = block.reshape(-1, *target.shape[1:])


def _shape(source: h5py.Dataset) -> tuple[int, ...]:
    """Shape of the copy: a member that must be a vector loses the second axis that MATLAB adds."""
    parts = source.name.strip("/").split("/")
    vector = parts[-1] in VECTORS or parts[0] in TABLES
    return (source.size,) if vector and source.ndim == 2 and 1 in source.shape else source.shape


def _kind(source: h5py.Dataset) -> np.dtype:
    return np.dtype("u1") if source.dtype.kind == "b" else source.dtype


def _attributes(source: h5py.Group | h5py.Dataset) -> Iterator[tuple[str, AttributeValue]]:
    """Attributes that are one number, one text or a list of texts."""
    for name in source.attrs:
        if name.startswith(SCALES):
            continue
        value = np.asarray(source.attrs[name])
        if value.dtype.kind in "SUO" and all(isinstance(text, str | bytes) for text in value.flat):
            texts = [_text(text) for text in value.flat]
            yield name, texts[0] if value.size == 1 else texts
        elif value.dtype.kind in "biuf" and value.size == 1:
            yield name, value.item()


def _text(value: Any) -> str:
    """A text of an HDF5 file, without the zero bytes at the end that C writes."""
    return (value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)).rstrip("\0")
