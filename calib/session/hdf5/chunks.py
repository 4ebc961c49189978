"""Guarded reading of one dataset, chunk by chunk, in bounded memory.

The HDF5 library only delivers the stored bytes of a chunk. This module verifies the checksum, inflates and
unshuffles, because the library's own inflate expands its buffer to whatever the stream holds (1 MB becomes 1 GB),
trusts the size of a chunk, and returns zeros for a chunk that was never written.
"""

import itertools
import math
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from h5py import h5d, h5p, h5s, h5t, h5z

from .guard import DAMAGED, Node, plain_type, translated, type_kind

MAX_RANK = 4
MAX_CHUNK_BYTES = 16 << 20
MAX_CHUNKS = 1 << 20
KEPT_BYTES = 16 << 20  # of decoded chunks of a dataset
MAX_COMPACT_BYTES = 64 << 10
MAX_TEXT_BYTES = 4096
WRITE_AS = "write it chunked with gzip, shuffle and fletcher32, or convert the file with `jaxeit import hdf5`"
ALLOWED = (h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32)


@dataclass
class GuardedArray:
    """A dataset whose `shape`, `dtype` and `chunk` were checked; `read` returns rows.

    The constructor raises `SessionError` for types, layouts, filters and sizes that are not allowed. Reading raises
    it for a chunk that is missing, damaged or too large.
    """

    node: Node
    shape: tuple[int, ...] = field(init=False)
    dtype: np.dtype = field(init=False)
    chunk: tuple[int, ...] = field(init=False)
    filters: tuple[int, ...] = field(init=False, default=())
    _decoded: OrderedDict[tuple[int, ...], np.ndarray] = field(init=False, default_factory=OrderedDict, repr=False)

    def __post_init__(self) -> None:
        with translated(self.node.path, self.node.where):
            plist = self.node.id.get_create_plist()
            self._check_storage(plist)
            self._check_type()
            self._check_layout(plist)

    def _check_storage(self, plist: h5p.PropDCID) -> None:
        """Refuse data in other files, before the library opens these to find the shape of a virtual dataset."""
        if plist.get_layout() == h5d.VIRTUAL:
            raise self.node.error("is a virtual dataset, which reads other files", WRITE_AS)
        if plist.get_external_count():
            raise self.node.error("has external storage, which reads other files", WRITE_AS)

    def _check_type(self) -> None:
        node, kind = self.node, self.node.id.get_type()
        if not plain_type(kind):
            raise node.error(f"is {type_kind(kind)}", "write plain numbers or fixed-length texts")
        if kind.get_class() == h5t.STRING and kind.get_size() > MAX_TEXT_BYTES:
            raise node.error(f"holds texts of {kind.get_size():,} bytes", "keep texts short")
        self.shape, self.dtype = node.id.shape, np.dtype(kind.dtype.str)
        if self.shape is None or len(self.shape) > MAX_RANK:
            raise node.error("has no shape or too many dimensions", f"use at most {MAX_RANK}")
        node.claims.add(node.where, self.nbytes)

    @property
    def nbytes(self) -> int:
        """Logical size in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def row_bytes(self) -> int:
        """Size of one row in bytes."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    def _check_layout(self, plist: h5p.PropDCID) -> None:
        layout = plist.get_layout()
        if layout == h5d.COMPACT and self.nbytes <= MAX_COMPACT_BYTES:
            self.chunk = self.shape
        elif layout == h5d.CHUNKED:
            self._check_chunks(plist)
        else:
            raise self.node.error("is stored without checksum", WRITE_AS)

    def _check_chunks(self, plist: h5p.PropDCID) -> None:
        node, self.chunk = self.node, plist.get_chunk()
        self.filters = tuple(plist.get_filter(i)[0] for i in range(plist.get_nfilters()))
        unknown = [plist.get_filter(i) for i, f in enumerate(self.filters) if f not in ALLOWED]
        if unknown:
            raise node.error(f"uses the filter {unknown[0][3].decode()!r}", WRITE_AS)
        if self.filters[-1:] != (h5z.FILTER_FLETCHER32,):
            raise node.error("is stored without checksum", WRITE_AS)
        size = math.prod(self.chunk) * self.dtype.itemsize
        if size > MAX_CHUNK_BYTES:
            raise node.error(f"has chunks of {size:,} bytes", "use chunks of about 256 kB")
        self._check_chunk_count()

    def _check_chunk_count(self) -> None:
        expected = math.prod(-(-n // c) for n, c in zip(self.shape, self.chunk, strict=True))
        if expected > MAX_CHUNKS:
            raise self.node.error(f"has {expected:,} chunks", "use chunks of about 256 kB")
        stored = self.node.id.get_num_chunks() if expected else 0
        if stored != expected:
            raise self.node.error(f"{expected - stored:,} of {expected:,} chunks missing", DAMAGED)

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows ``start:stop`` (all by default) as stored; a scalar if the dataset is one.

        `SessionError` if they are more bytes than the budget allows at once.
        """
        rows = len(range(*slice(start, stop).indices(self.shape[0]))) if self.shape else 1
        self.node.require("array_bytes", rows * self.row_bytes)
        with self.node.reads():
            if not self.shape or self.node.id.get_create_plist().get_layout() == h5d.COMPACT:
                return self._read_compact()[slice(start, stop) if self.shape else ...]
            start, stop, _ = slice(start, stop).indices(self.shape[0])
            return self._gather(start, max(start, stop))

    def _read_compact(self) -> np.ndarray:
        out = np.zeros(self.shape, self.dtype)
        if out.size:
            self.node.id.read(h5s.ALL, h5s.ALL, out)
        return out

    def _gather(self, start: int, stop: int) -> np.ndarray:
        out = np.empty((stop - start, *self.shape[1:]), self.dtype)
        for origin in self._origins(start, stop):
            low = max(start - origin[0], 0)
            high = min(stop - origin[0], self.chunk[0])
            inner = [slice(0, n - o) for n, o in zip(self.shape[1:], origin[1:], strict=True)]
            block = self._chunk_at(origin)[(slice(low, high), *inner)]
            rows = slice(origin[0] + low - start, origin[0] + low - start + len(block))
            place = [slice(o, o + n) for o, n in zip(origin[1:], block.shape[1:], strict=True)]
            out[(rows, *place)] = block
        return out

    def _origins(self, start: int, stop: int) -> Iterator[tuple[int, ...]]:
        first = start - start % self.chunk[0]
        rows = range(first, stop if stop > start else first, self.chunk[0])
        rest = [range(0, n, c) for n, c in zip(self.shape[1:], self.chunk[1:], strict=True)]
        return itertools.product(rows, *rest)

    def _chunk_at(self, origin: tuple[int, ...]) -> np.ndarray:
        """A chunk; the last few are kept, because check and calibration read a session press by press, in turn."""
        if origin not in self._decoded:
            self._decoded[origin] = self._decode(origin)
            while len(self._decoded) > 1 and len(self._decoded) * self._decoded[origin].nbytes > KEPT_BYTES:
                self._decoded.popitem(last=False)
        self._decoded.move_to_end(origin)
        return self._decoded[origin]

    def _decode(self, origin: tuple[int, ...]) -> np.ndarray:
        size = math.prod(self.chunk) * self.dtype.itemsize
        info = self.node.id.get_chunk_info_by_coord(origin)
        if info.byte_offset is None or info.size > size + size // 64 + 4096:
            raise self.node.error(f"chunk {origin} is missing or too long", DAMAGED)
        mask, raw = self.node.id.read_direct_chunk(origin)
        for place in reversed(range(len(self.filters))):
            skipped = mask >> place & 1
            raw = self._undo(self.filters[place], bool(skipped), bytes(raw), size, origin)
        if len(raw) != size:
            raise self.node.error(f"chunk {origin} has the wrong size", DAMAGED)
        return np.frombuffer(raw, self.dtype).reshape(self.chunk)

    def _undo(self, code: int, skipped: bool, raw: bytes, size: int, at: tuple[int, ...]) -> bytes:
        """Undo one filter. For a single chunk, a writer may have skipped any filter but the checksum."""
        if code == h5z.FILTER_FLETCHER32:
            if skipped or not checksum_holds(raw):
                raise self.node.error(f"the checksum of chunk {at} does not hold", DAMAGED)
            return raw[:-4]
        if skipped:
            return raw
        if code == h5z.FILTER_SHUFFLE:
            return unshuffle(raw, self.dtype.itemsize)
        plain = inflate(raw, size)
        if plain is None:
            raise self.node.error(f"chunk {at} does not inflate to {size:,} bytes", DAMAGED)
        return plain


def inflate(raw: bytes, size: int) -> bytes | None:
    """Inflate `raw` to exactly `size` bytes; None if it holds more or fewer, or is damaged."""
    stream = zlib.decompressobj()
    try:
        plain = stream.decompress(raw, size + 1)
    except zlib.error:
        return None
    return plain if len(plain) == size and stream.eof else None


def unshuffle(raw: bytes, itemsize: int) -> bytes:
    """Undo the byte shuffle of HDF5, which stores the first bytes of all items, then the second bytes, and so on."""
    if itemsize == 1 or len(raw) % itemsize:
        return raw
    return np.frombuffer(raw, np.uint8).reshape(itemsize, -1).T.tobytes()


def checksum_holds(raw: bytes) -> bool:
    """Whether the last four bytes are the Fletcher-32 checksum of the others.

    Sums over 16-bit big-endian words w_1..w_n modulo 65535: s1 = sum w_i, s2 = sum (n-i+1) w_i
    (J. Fletcher, IEEE Trans. Commun. 30, 1982; byte order as in HDF5's H5checksum.c).
    """
    if len(raw) < 4:
        return False
    body, stored = raw[:-4], int.from_bytes(raw[-4:], "little")
    words = np.frombuffer(body + b"\0" * (len(body) % 2), ">u2").astype(np.uint64)
    weights = np.arange(len(words), 0, -1, dtype=np.uint64) % np.uint64(65535)
    s1 = int(words.sum()) % 65535
    s2 = int((words * weights).sum(dtype=np.uint64)) % 65535
    return (stored & 0xFFFF) % 65535 == s1 and (stored >> 16) % 65535 == s2
