"""NumPy's files of arrays, .npz and .npy."""

import contextlib
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from io import BufferedIOBase
from pathlib import Path
from typing import ClassVar, cast

import numpy as np
from numpy.lib import format as npy

from ...errors import SessionError, problem
from ..arrays import AbstractArrayImporter, ArrayShape, table_shape, table_values
from ..child import DAMAGED
from ..limits import MAX_NAMES
from ..tables.table import first_bytes

NUMBERS = "biufmM"
HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class NpzImporter(AbstractArrayImporter):
    """Arrays saved by NumPy; objects (pickles) are never loaded.

    The shape of each array is read from its header and compared with the limits before the array is.
    """

    name: ClassVar[str] = "npz"
    summary: ClassVar[str] = "arrays saved by NumPy (.npz, .npy)"
    isolated: ClassVar[bool] = False

    @classmethod
    def outline(cls, path: Path) -> dict[str, ArrayShape]:
        """See `AbstractArrayImporter.outline`."""
        shapes = {}
        with _members(path) as members:
            for name, stream in members:
                shape = _claimed_shape(path, name, stream)
                if shape is not None:
                    shapes[name] = shape
        return shapes

    @classmethod
    def arrays(cls, path: Path, names: Sequence[str]) -> list[np.ndarray]:
        """See `AbstractArrayImporter.arrays`."""
        found = {}
        with _members(path, set(names)) as members:
            for name, stream in members:
                values = npy.read_array(stream, allow_pickle=False)
                stream.read(1)  # the end of a member is where its checksum is compared
                shape = table_shape(values.shape)
                if shape is not None:
                    found[name] = table_values(values, shape)
        return [found[name] for name in names]


@contextlib.contextmanager
def _members(path: Path, wanted: set[str] | None = None) -> Iterator[Iterator[tuple[str, BufferedIOBase]]]:
    """Names and streams of the arrays of a file, or of those wanted; any error becomes one `SessionError`."""
    single = first_bytes(path).startswith(npy.MAGIC_PREFIX)
    try:
        yield _single(path) if single else _zipped(path, wanted)
    except SessionError:
        raise
    except (ValueError, OSError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise problem(path, "file", f"cannot be read ({' '.join(str(error).split())})", DAMAGED) from error


def _single(path: Path) -> Iterator[tuple[str, BufferedIOBase]]:
    with path.open("rb") as stream:
        yield path.stem, stream


def _zipped(path: Path, wanted: set[str] | None) -> Iterator[tuple[str, BufferedIOBase]]:
    with zipfile.ZipFile(path) as archive:
        members = archive.namelist()
        if len(members) > MAX_NAMES:
            raise problem(path, "file", f"holds {len(members):,} arrays", "give a file of fewer")
        for member in members:
            name = member.removesuffix(".npy")
            if member.endswith(".npy") and (wanted is None or name in wanted):
                with archive.open(member) as stream:
                    yield name, cast(BufferedIOBase, stream)


def _claimed_shape(path: Path, name: str, stream: BufferedIOBase) -> ArrayShape | None:
    """The shape that the header of an array states; None for an array that is no table of numbers."""
    version = npy.read_magic(stream)
    if version not in HEADERS:
        raise problem(path, name, f"is of the unknown version {version}", "save it with another version of NumPy")
    shape, _, kind = HEADERS[version](stream)
    return table_shape(shape, "s" if kind.kind == "M" else "") if kind.kind in NUMBERS else None
