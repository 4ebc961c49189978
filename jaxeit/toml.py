"""TOML files read key by key: errors name the key that is missing, wrong or unknown, and the reason.

Example:
    from pathlib import Path

    import jaxeit as je

    Path("stage.toml").write_text("speed = 0.01\\nhome = [0, 0]\\n")


    def build(table):  # a stage of your own, from its file
        found = table.positive("speed", "speed in m/s"), table.vector("home", 2, "place in m")
        table.done()  # refuses keys that nobody reads
        return found


    text = je.toml.read_text(Path("stage.toml"))
    print(je.toml.parse_toml(text, "stage.toml", build), je.toml.parse_values(text, "stage.toml"))
    try:
        je.toml.parse_toml(text + "sped = 1", "stage.toml", build)
    except je.toml.TomlError as error:
        print(error)
"""

import codecs
import math
import os
import re
import reprlib
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .budget import current_budget, require
from .files import open_regular
from .messages.spelling import did_you_mean, nearest

__all__ = [
    "TomlError",
    "TomlTable",
    "parse_toml",
    "parse_values",
    "read_text",
]

MAX_KEY_PARTS = 16
"""Largest number of parts of one dotted key: the parser's time and memory grow with the square of this number."""

MAX_DEPTH = 32
"""Largest depth of nested arrays and inline tables: the parser calls itself once per level."""

T = TypeVar("T")

# Values in messages are cut to 60 characters, so that a message remains one line.
SHORT_REPR = reprlib.Repr()
SHORT_REPR.maxstring = SHORT_REPR.maxother = SHORT_REPR.maxlong = 60


class TomlError(ValueError):
    """A file that cannot be used; the message names the file, the key and the reason."""


def read_text(path: Path) -> str:
    """The text of a file; raises a `TomlError` that names the file if it cannot be read."""
    try:
        with open_regular(path) as file:
            size, raw = os.fstat(file.fileno()).st_size, file.read(current_budget().text_bytes)
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(raw, final=size <= len(raw))
        require("text_bytes", size, str(path), TomlError)
        return text
    except UnicodeDecodeError:
        raise TomlError(f"{path}: is not text; give a TOML file") from None
    except OSError as error:
        raise TomlError(f"{path}: cannot be read ({error.strerror}); check the name and the folder") from None


def parse_toml(text: str, source: str, build: Callable[["TomlTable"], T], allow_import: bool = False) -> T:
    """The result of ``build`` for the text; a ValueError of ``build`` becomes a `TomlError` that names ``source``.

    Args:
        allow_import: whether the text may name classes by import path.  Set it for a file that the user names, not for
            text that a session or calibration file holds.
    """
    try:
        return build(TomlTable(parse_values(text, source), source, allow_import))
    except TomlError:
        raise
    except ValueError as error:  # a class refused the values of its settings
        raise TomlError(f"{source}: {error}") from None


def parse_values(text: str, source: str) -> dict[str, Any]:
    """The values of a TOML text; raises a `TomlError` that names ``source`` if the text is not TOML or too large.

    The limits are checked first, because the parser needs time and memory that grow with the square of a key's parts.
    """
    require("text_bytes", len(text), source, TomlError)
    if reason := _beyond_limits(text):
        raise TomlError(f"{source}: not valid TOML: {reason}")
    try:
        return tomllib.loads(text)
    except ValueError as error:  # from the parser, or from Python for a number with too many digits
        raise TomlError(f"{source}: not valid TOML: {error}") from None
    except RecursionError:  # the caller had already used most of the stack
        raise TomlError(f"{source}: not valid TOML: nested too deeply") from None


# Strings, comments, and the marks that are counted. A string without a closing quote ends with its line, so that the
# scan reads every character once and its time is linear.
_TOKENS = re.compile(
    r"""(?P<text>"{3}(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?|'{3}(?:[^']|'(?!''))*+(?:'{3,5})?"""
    r"""|"(?:[^"\\\n]|\\[^\n])*+"?|'[^'\n]*+'?)|(?P<comment>\#[^\n]*+)"""
    r"""|(?P<word>[\w+-]++|[ \t]++)|(?P<dot>\.)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<other>.)""",
    re.DOTALL,
)


def _beyond_limits(text: str) -> str:
    """The reason why a TOML text exceeds the limits of depth and key parts; empty if it does not."""
    depth = dots = 0
    for token in _TOKENS.finditer(text):
        kind = token.lastgroup
        if kind == "dot":
            dots += 1
        elif kind not in ("text", "word"):
            dots = 0
        depth += (kind == "open") - (kind == "close")
        if dots >= MAX_KEY_PARTS or depth > MAX_DEPTH:
            line = text.count("\n", 0, token.start()) + 1
            what = f"a key of more than {MAX_KEY_PARTS} parts" if dots >= MAX_KEY_PARTS else "nested too deeply"
            return f"{what} (at line {line})"
    return ""


class TomlTable:
    """A TOML table that is read key by key; `done` refuses keys that were not read."""

    def __init__(self, values: dict[str, Any], where: str, allow_import: bool = False):
        self._values, self.where, self._asked = values, where, set[str]()
        self.allow_import = allow_import

    def error(self, key: str, reason: str) -> TomlError:
        """A `TomlError` that names the file, the key and the reason; the caller raises it."""
        return TomlError(f"{self.where}: {key}: {reason}")

    def has(self, key: str) -> bool:
        """Whether the table has the key; `done` then counts the key as known."""
        self._asked.add(key)
        return key in self._values

    def get(self, key: str, kind: Callable[[Any], bool], meaning: str, default: Any = ...) -> Any:
        """The value of a key.

        Args:
            kind: whether a value is acceptable.
            meaning: what to give, for messages.
            default: the value of a missing key; if it is not given, the key is required.

        Raises:
            TomlError: for a required key that is missing, or a value that is not acceptable.
        """
        if not self.has(key):
            if default is ...:
                near = nearest(key, self._values.keys() - self._asked, least=0.75)
                hint = f"; is {SHORT_REPR.repr(near)} a misspelling of it?" if near else ""
                raise self.error(key, f"missing; give {meaning}{hint}")
            return default
        value = self._values[key]
        if not kind(value):
            raise self.error(key, f"is {SHORT_REPR.repr(value)}; give {meaning}")
        return value

    def number(self, key: str, meaning: str, default: Any = ..., least: float = 0.0, most: float = math.inf) -> float:
        """A finite number from ``least`` to ``most``; arguments and errors as for `get`."""

        def good(value: Any) -> bool:
            return _is_number(value) and least <= value <= most

        return float(self.get(key, good, meaning, default))

    def positive(self, key: str, meaning: str) -> float:
        """A finite number above zero; arguments and errors as for `get`."""
        return float(self.get(key, lambda v: _is_number(v) and v > 0, f"{meaning}, above zero"))

    def count(self, key: str) -> int:
        """A whole number from 1 to `MAX_COUNT`; errors as for `get`."""
        meaning = f"a whole number from 1 to {MAX_COUNT:,}"
        return int(self.get(key, lambda v: type(v) is int and 0 < v <= MAX_COUNT, meaning))

    def choice(self, key: str, *names: str, default: Any = ...) -> str:
        """One of ``names``; errors as for `get`."""
        meaning = ("one of " if len(names) > 1 else "") + ", ".join(f'"{name}"' for name in names)
        chosen: str = self.get(key, lambda v: v in names, meaning, default)
        return chosen

    def array(self, key: str, columns: int | None, meaning: str) -> np.ndarray:
        """Finite numbers: (rows, columns), or (numbers,) if ``columns`` is None, never empty; errors as for `get`."""

        def good(value: Any) -> bool:
            rows = value if columns is not None else [value]
            return (
                isinstance(value, list)
                and len(rows) > 0
                and all(isinstance(row, list) and all(map(_is_number, row)) for row in rows)
                and (columns is None or all(len(row) == columns for row in rows))
            )

        return np.array(self.get(key, good, meaning))

    def vector(self, key: str, length: int, meaning: str) -> tuple[float, ...]:
        """A list of ``length`` finite numbers; errors as for `get`."""
        value = self.array(key, None, meaning)
        if len(value) != length:
            raise self.error(key, f"has {len(value)} numbers; give {meaning}")
        return tuple(map(float, value))

    def table(self, key: str) -> "TomlTable":
        """The table ``[key]``; errors as for `get`."""
        value = self.get(key, lambda v: isinstance(v, dict), f"a table [{key}]")
        return TomlTable(value, f"{self.where}: [{key}]", self.allow_import)

    def tables(self, key: str) -> list["TomlTable"]:
        """The tables ``[[key]]`` in the order of the file, none if the key is missing; errors as for `get`."""

        def good(value: Any) -> bool:
            return isinstance(value, list) and all(isinstance(v, dict) for v in value)

        values = self.get(key, good, f"tables [[{key}]]", [])
        where = f"{self.where}: [[{key}]] number"
        return [TomlTable(v, f"{where} {i + 1}", self.allow_import) for i, v in enumerate(values)]

    def done(self) -> None:
        """Raise a `TomlError` for the first key that was not read, naming the nearest known key."""
        for key in self._values:
            if key not in self._asked:
                known = f"known: {', '.join(sorted(self._asked))}" if self._asked else "leave it out: there are no keys"
                hint = did_you_mean(key, self._asked, known)
                raise self.error(SHORT_REPR.repr(key)[1:-1], f"unknown key; {hint}")


MAX_COUNT = 1_000_000
"""Limit of everything that is counted: electrodes, rows, places."""


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number that a float can hold."""
    return (type(value) is int and abs(value) < 1 << 63) or (type(value) is float and math.isfinite(value))
