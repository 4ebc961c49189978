"""Lines of a text file, plain or gzip: counted and bounded before and while they are read."""

import codecs
import contextlib
import gzip
import re
import zlib
from collections.abc import Iterator
from io import BufferedReader, TextIOWrapper
from pathlib import Path

from ...errors import problem
from ..limits import MAX_LINE, require_within
from ..tables.table import first_bytes

PIECE = 1 << 20
_SEPARATOR_LINE = re.compile(r'"?sep=.?"?\s*')


def _open_bytes(path: Path) -> "BufferedReader | gzip.GzipFile":
    packed = first_bytes(path).startswith(b"\x1f\x8b")
    return gzip.open(path) if packed else path.open("rb")


@contextlib.contextmanager
def _reading(path: Path, where: str = "file") -> Iterator[None]:
    """Turn errors of a damaged gzip file and of the disk into one `SessionError`."""
    try:
        yield
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise problem(path, where, f"the gzip file is damaged ({error})", "take another copy") from error
    except OSError as error:
        raise problem(path, where, f"cannot be read ({error.strerror})", "check access") from error


def count_lines(path: Path) -> int:
    """Line ends in the file; raises `SessionError` as soon as they, or the unpacked bytes, are beyond the limits."""
    lines = returns = size = 0
    with _reading(path), _open_bytes(path) as stream:
        while piece := stream.read(PIECE):
            lines, returns, size = lines + piece.count(b"\n"), returns + piece.count(b"\r"), size + len(piece)
            require_within(path, "import_text", size)
            require_within(path, "import_rows", max(lines, returns))
    return max(lines, returns)


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers from 1, and the lines that hold data (`is_data`)."""
    return (numbered for numbered in every_line(path) if is_data(*numbered))


def is_data(number: int, line: str) -> bool:
    """Whether a line is neither blank nor a comment; a first line ``sep=;`` is for Excel alone."""
    skipped = line.startswith("#") or (number == 1 and _SEPARATOR_LINE.fullmatch(line))
    return bool(line.strip()) and not skipped


def every_line(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers from 1, and lines without their ends."""
    utf16 = first_bytes(path).startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    encoding = "utf-16" if utf16 else "utf-8-sig"
    number = 0
    with _open_bytes(path) as raw, TextIOWrapper(raw, encoding, errors="replace") as stream:
        while line := _next_line(path, stream, number + 1):
            number += 1
            yield number, line.rstrip("\r\n")


def _next_line(path: Path, stream: TextIOWrapper, number: int) -> str:
    with _reading(path, f"line {number}"):
        line = stream.readline(MAX_LINE)
    if len(line) >= MAX_LINE or "\0" in line:
        raise problem(path, f"line {number}", "is not text", "give a CSV file")
    return line
