"""Guarded access to HDF5 files: nothing in a file is trusted before it has been checked.

A session may come from anywhere, and the HDF5 library follows links to other files, loads plug-ins, allocates
what a header claims and does not check every number. This module therefore checks the header first, without the
library, and whether the file is whole. Then it opens groups and datasets by name, through hard links only, with
bounded numbers of members and attributes. Values are plain numbers and fixed-length texts only.
"""

import contextlib
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5t

from jaxeit.budget import current_budget
from jaxeit.files import open_regular

from ..errors import SessionError, printable, problem

SIGNATURE = b"\x89HDF\r\n\x1a\n"
MAX_ATTRIBUTES = 256
MAX_ATTRIBUTE_BYTES = 256 << 10
MAX_ATTRIBUTE_ITEMS = 64
MAX_MEMBERS = 1024
DEFLATE_RATIO = 1040
"""Limit of stored over compressed size: one byte of deflate expands to at most 1032 bytes."""

CONVERT = "convert the file with `jaxeit import hdf5 {} -o session.h5`"
DAMAGED = "the file is damaged; take another copy, or record it again"


@dataclass
class Claims:
    """Total size in bytes that the headers of the arrays of one file state, for the arrays accessed so far."""

    path: Path
    claimed: int = 0
    seen: set[str] = field(default_factory=set)

    def add(self, where: str, size: int) -> None:
        """Count the `size` bytes of the array `where`, once for each array; `SessionError` beyond the budget."""
        if where in self.seen:
            return
        self.seen.add(where)
        self.claimed += size
        plausible = DEFLATE_RATIO * os.path.getsize(self.path)
        if size > plausible:
            what = f"claims {size:,} bytes, more than a file of this size can hold"
            raise problem(self.path, where, what, DAMAGED)
        require_within(self.path, where, "file_bytes", self.claimed)


def require_within(path: Path, where: str, limit: str, asked: float) -> None:
    """Raise `SessionError` if more is asked for than the budget's limit of that name allows."""
    if beyond := current_budget().excess(limit, asked):
        raise problem(path, where, *beyond)


@contextlib.contextmanager
def translated(path: Path, where: str) -> Iterator[None]:
    """Turn any error of the HDF5 library into one `SessionError`."""
    try:
        yield
    except SessionError:
        raise
    except UnicodeDecodeError as error:
        raise problem(path, where, "a text is not UTF-8", DAMAGED) from error
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise problem(path, where, f"HDF5 reports {printable(error, 120)}", DAMAGED) from error


def check_file(path: Path) -> None:
    """Refuse a file that is not a whole HDF5 file with checksums, without calling the library."""
    head = _first_bytes(path)
    if not head:
        raise problem(path, "file", "is empty", "check the recorder, or take another copy")
    if not head.startswith(SIGNATURE):
        what, todo = _foreign_kind(head)
        raise problem(path, "file", what, todo)
    _check_superblock(path, head)


def _first_bytes(path: Path) -> bytes:
    try:
        with open_regular(path) as stream:
            return stream.read(512)
    except IsADirectoryError:
        raise problem(path, "file", "is a folder", "name the .h5 file in it") from None
    except FileNotFoundError:
        raise problem(path, "file", "does not exist", "check the name and the folder") from None
    except OSError as error:
        raise problem(path, "file", f"cannot be read ({error.strerror})", "check the name and access") from error


def _foreign_kind(head: bytes) -> tuple[str, str]:
    """Kind of a file without the HDF5 signature, and what to do about it."""
    sessions = "give a session file (.h5)"
    if head[:1] == b"\x80" and head[1:2] in b"\x02\x03\x04\x05":
        return "is a Python pickle, which could run any code", "it is never read; " + sessions
    if head.startswith((b"\x93NUMPY", b"PK\x03\x04")):
        return "is a NumPy or zip file, not HDF5", "use `jaxeit import npz` for arrays"
    if head.startswith(b"MATLAB "):
        return "is a MATLAB file", "use `jaxeit import mat`"
    if head.startswith(b"PAR1"):
        return "is a Parquet file, not HDF5", "use `jaxeit import parquet`"
    if head.startswith(b"\x89MCAP"):
        return "is an MCAP file, not HDF5", "use `jaxeit import mcap`"
    if head.startswith(b"CDF"):
        return "is a classic netCDF file, not HDF5", "convert it with `nccopy -k nc4`"
    if head.startswith(b"\x1f\x8b"):
        return "is a gzip file, not HDF5", "unpack it, or use `jaxeit import csv` for a table"
    if not all(32 <= b < 127 or b in b"\t\r\n" or b >= 128 for b in head):
        return "is not an HDF5 file", sessions
    if head.lstrip().startswith(b"<"):
        return "is a web page or XML, not HDF5", "look whether the download failed; " + sessions
    if re.search(rb"^(\[[\w.]+\]|\w+ *= *\S.*)\s*$", head, re.MULTILINE):
        return "is text, not HDF5; it looks like TOML", sessions + "; `jaxeit simulate` makes one of a scene"
    return "is text, not HDF5; it looks like CSV", "use `jaxeit import csv`"


BROKEN_OFF = "copy it again; of a recording that broke off, `jaxeit recover` reads the file that ends in .part"


def _check_superblock(path: Path, head: bytes) -> None:
    """Check version, lengths, open flag and end of file (HDF5 file format specification, section II.A)."""
    if len(head) < 48:
        raise problem(path, "file", f"is truncated after {len(head)} bytes", DAMAGED)
    version, offsets, lengths, flags = head[8:12]
    if version != 3:
        what = f"is in an older HDF5 layout (superblock {version}) without checksums"
        raise problem(path, "file", what, CONVERT.format(printable(path.name)))
    base, _, end, _ = struct.unpack("<4Q", head[12:44])
    if (offsets, lengths, base) != (8, 8, 0):
        raise problem(path, "file", "has an unusual HDF5 header", DAMAGED)
    if flags:
        raise problem(path, "file", "was never closed by its writer", BROKEN_OFF)
    size = path.stat().st_size
    if end > size:
        what = f"is truncated: {size:,} of {end:,} bytes are there"
        raise problem(path, "file", what, BROKEN_OFF)


def open_guarded(path: Path) -> h5py.File:
    """Open a file for reading after `check_file`; raises `SessionError`."""
    check_file(path)
    with translated(path, "file"):
        return h5py.File(path, "r", locking="best-effort", rdcc_nbytes=1 << 20)


@dataclass(frozen=True)
class Node:
    """A group or dataset that was reached by guarded access: its file, its path in it, and its handle."""

    path: Path
    where: str
    id: h5g.GroupID | h5d.DatasetID
    claims: Claims

    def error(self, what: str, todo: str) -> Exception:
        """A `SessionError` about this node."""
        return problem(self.path, self.where, what, todo)

    def require(self, limit: str, asked: float) -> None:
        """Raise `SessionError` if more is asked for than the budget's limit of that name allows."""
        require_within(self.path, self.where, limit, asked)

    @contextlib.contextmanager
    def reads(self, where: str = "") -> Iterator[None]:
        """Turn errors of the library into one `SessionError`, also where the file was closed before.

        Args:
            where: what is read, if it is a part of the node.
        """
        if not self.id.valid:
            raise self.error("is read after its file was closed", "read it before, inside the `with` of the file")
        with translated(self.path, where or self.where):
            yield

    def child(self, name: str) -> "Node | None":
        """The member `name`, or None. A name that is a path, and a link to elsewhere, are refused."""
        where = f"{self.where.rstrip('/')}/{name}"
        if not is_member_name(name):
            # The library takes names for paths, and would follow any link on the way.
            raise self.error(f"names the member {printable(name)!r}, which is a path", "give the name of one member")
        with self.reads(where):
            if not self.id.links.exists(name.encode()):
                return None
            kind = self.id.links.get_info(name.encode()).type
            if kind != h5l.TYPE_HARD:
                what = f"is {_link_kind(kind)}, which may lead out of the file"
                raise problem(self.path, where, what, "store the data itself in the file")
            opened = h5o.open(self.id, name.encode())
        if not isinstance(opened, h5g.GroupID | h5d.DatasetID):
            raise problem(self.path, where, "is neither group nor dataset", DAMAGED)
        return Node(self.path, where, opened, self.claims)

    def group(self, name: str) -> "Node | None":
        """The member `name` as a group, or None."""
        node = self.child(name)
        if node is not None and not isinstance(node.id, h5g.GroupID):
            raise node.error("is a dataset where a group belongs", "see data/schema/README.md")
        return node

    def dataset(self, name: str) -> "Node | None":
        """The member `name` as a dataset, or None."""
        node = self.child(name)
        if node is not None and not isinstance(node.id, h5d.DatasetID):
            raise node.error("is a group where a dataset belongs", "see data/schema/README.md")
        return node

    def members(self, limit: int = MAX_MEMBERS) -> list[str]:
        """Names of the members, sorted; refused before listing if there are more than `limit`."""
        with self.reads():
            count = self.id.get_num_objs()
            if count > limit:
                what = f"has {count:,} members, the limit is {limit:,}"
                raise self.error(what, "not a file of this program; name another")
            names: list[bytes] = []
            self.id.links.iterate(names.append)
            return sorted(name.decode() for name in names)

    def attribute_names(self) -> list[str]:
        """Names of the attributes, sorted; refused if there are more than `MAX_ATTRIBUTES`."""
        with self.reads():
            count = h5a.get_num_attrs(self.id)
            if count > MAX_ATTRIBUTES:
                what = f"has {count:,} attributes, the limit is {MAX_ATTRIBUTES}"
                raise self.error(what, "not a file of this program; name another")
            found = [h5a.open(self.id, index=i).name for i in range(count)]
            return sorted(n.decode() if isinstance(n, bytes) else n for n in found)

    def attribute(self, name: str) -> str | int | float | np.ndarray | None:
        """Value of an attribute, or None if it is missing; `SessionError` for types that are not plain."""
        with self.reads(f"{self.where}@{name}"):
            if not h5a.exists(self.id, name.encode()):
                return None
            return _attribute_value(self, name, h5a.open(self.id, name.encode()))

    def plain_attributes(self) -> dict[str, str | int | float]:
        """All attributes that are one number or one fixed-length text; others are ignored."""
        found = {}
        for name in self.attribute_names():
            with contextlib.suppress(ValueError):
                value = self.attribute(name)
                if isinstance(value, str | int | float):
                    found[name] = value
        return found

    def text(self, name: str, default: str | None = None) -> str:
        """Value of a text attribute; `SessionError` if it is missing without a default, or not a text."""
        value = self.attribute(name)
        if value is None and default is not None:
            return default
        if not isinstance(value, str):
            what = f"attribute {name} is {'missing' if value is None else 'not a text'}"
            raise self.error(what, f"write {name} as a fixed-length text")
        return value

    def number(self, name: str, default: float | None = None) -> float | int:
        """Value of a number attribute; `SessionError` if it is missing without a default, or not a finite number."""
        value = self.attribute(name)
        if value is None and default is not None:
            return default
        if not isinstance(value, int | float) or not np.isfinite(value):
            what = f"attribute {name} is {'missing' if value is None else 'not a finite number'}"
            raise self.error(what, f"write {name} as one number")
        return value


def is_member_name(name: str) -> bool:
    """Whether a name is that of one member of a group, and no path: HDF5 ends a name at a zero byte."""
    return name not in ("", ".") and not {"/", "\0"} & set(name)


def _link_kind(kind: int) -> str:
    names = {h5l.TYPE_SOFT: "a soft link", h5l.TYPE_EXTERNAL: "an external link"}
    return names.get(kind, "a user-defined link")


def _attribute_value(node: Node, name: str, attr: h5a.AttrID) -> str | int | float | np.ndarray | None:
    """Read one attribute of a plain type and modest size."""
    kind, shape = attr.get_type(), attr.get_space()
    size = attr.get_storage_size()
    items = shape.get_simple_extent_npoints() if shape.get_simple_extent_type() != 2 else 0
    if size > MAX_ATTRIBUTE_BYTES or items > MAX_ATTRIBUTE_ITEMS:
        raise node.error(f"attribute {name} holds {size:,} bytes", "keep attributes small")
    if not plain_type(kind) or items < 1 or len(attr.shape) > 1:
        what = f"attribute {name} is {type_kind(kind)}"
        todo = "write one number or one fixed-length text, or " + CONVERT.format(printable(node.path.name))
        raise node.error(what, todo)
    value = np.zeros(attr.shape, kind.dtype)
    attr.read(value)
    if kind.get_class() == h5t.STRING:
        return np.char.decode(value, "utf-8") if attr.shape else bytes(value[()]).decode()
    return value[()].item() if not attr.shape else value


def plain_type(kind: h5t.TypeID) -> bool:
    """Whether an HDF5 type is an ordinary integer, float or fixed-length text."""
    if kind.get_class() == h5t.STRING:
        return not kind.is_variable_str()
    if kind.get_class() not in (h5t.INTEGER, h5t.FLOAT) or kind.get_size() not in (1, 2, 4, 8):
        return False
    return bool(h5t.py_create(kind.dtype).equal(kind))


def type_kind(kind: h5t.TypeID) -> str:
    """Describe an HDF5 type that is refused."""
    if kind.get_class() == h5t.STRING and kind.is_variable_str():
        return "a variable-length text"
    names = {
        h5t.VLEN: "of variable length",
        h5t.REFERENCE: "an object reference",
        h5t.COMPOUND: "a compound type",
        h5t.OPAQUE: "opaque bytes",
        h5t.ENUM: "an enumeration (h5py writes bool as one)",
        h5t.ARRAY: "an array type",
    }
    return names.get(kind.get_class(), "of an unusual type, shape or size")


def root_node(file: h5py.File, path: Path) -> Node:
    """The root group of an opened file as a `Node` with fresh `Claims`."""
    with translated(path, "file"):
        return Node(path, "/", h5g.open(file.id, b"/"), Claims(path))
