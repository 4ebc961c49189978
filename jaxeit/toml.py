"""TOML files read key by key: errors name the key that is missing, wrong or unknown, and the reason."""

import codecs
import difflib
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

__all__ = [
    "TomlError",
    "TomlTable",
    "parse_toml",
    "parse_values",
    "read_text",
]

MAX_KEY_PARTS = 16
"""Parts of one dotted key: the parser's time and memory grow with their square."""

MAX_DEPTH = 32
"""Arrays and inline tables within each other: the parser calls itself for each."""

T = TypeVar("T")

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60


class TomlError(ValueError):
    """A file that cannot be used; the message names the file, the key and the reason."""


def read_text(path: Path) -> str:
    """The text of a file, or a `TomlError` that names it."""
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
    """The result of ``build`` for the text; every ValueError on the way becomes a `TomlError` that names ``source``.

    Args:
        allow_import: whether the text may name classes by import path.  Set it for a file that the user names, not for
            text that a session or calibration file holds.
    """
    try:
        return build(TomlTable(parse_values(text, source), source, allow_import))
    except TomlError:
        raise
    except ValueError as error:  # an object refused the values it was given
        raise TomlError(f"{source}: {error}") from None


def parse_values(text: str, source: str) -> dict[str, Any]:
    """The values of a TOML text; a `TomlError` that names ``source`` for what is not TOML or too large.

    The limits are checked first, because the parser needs time and memory that grow with the square of a key's parts.
    """
    require("text_bytes", len(text), source, TomlError)
    if reason := _beyond_limits(text):
        raise TomlError(f"{source}: not valid TOML: {reason}")
    try:
        return tomllib.loads(text)
    except ValueError as error:  # the parser's own, and Python's of a number of too many digits
        raise TomlError(f"{source}: not valid TOML: {error}") from None
    except RecursionError:  # called at the end of a deep stack
        raise TomlError(f"{source}: not valid TOML: nested too deeply") from None


# Texts, comments, and the marks that are counted. A text without its end reaches to the end of its line, so that every
# character is looked at once.
_TOKENS = re.compile(
    r"""(?P<text>"{3}(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?|'{3}(?:[^']|'(?!''))*+(?:'{3,5})?"""
    r"""|"(?:[^"\\\n]|\\[^\n])*+"?|'[^'\n]*+'?)|(?P<comment>\#[^\n]*+)"""
    r"""|(?P<word>[\w+-]++|[ \t]++)|(?P<dot>\.)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<other>.)""",
    re.DOTALL,
)


def _beyond_limits(text: str) -> str:
    """What is nested too deeply in a TOML text, or named by too many parts; empty if nothing is."""
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
        return TomlError(f"{self.where}: {key}: {reason}")

    def has(self, key: str) -> bool:
        self._asked.add(key)
        return key in self._values

    def get(self, key: str, kind: Callable[[Any], bool], meaning: str, default: Any = ...) -> Any:
        if not self.has(key):
            if default is ...:
                raise self.error(key, f"missing; give {meaning}")
            return default
        value = self._values[key]
        if not kind(value):
            raise self.error(key, f"is {_SHORT.repr(value)}; give {meaning}")
        return value

    def number(self, key: str, meaning: str, default: Any = ..., least: float = 0.0) -> float:
        def good(value: Any) -> bool:
            return _is_number(value) and value >= least

        return float(self.get(key, good, meaning, default))

    def positive(self, key: str, meaning: str) -> float:
        return float(self.get(key, lambda v: _is_number(v) and v > 0, f"{meaning}, above zero"))

    def count(self, key: str) -> int:
        meaning = f"a whole number from 1 to {MAX_COUNT:,}"
        return int(self.get(key, lambda v: type(v) is int and 0 < v <= MAX_COUNT, meaning))

    def choice(self, key: str, *names: str, default: Any = ...) -> str:
        meaning = "one of " + ", ".join(f'"{name}"' for name in names)
        chosen: str = self.get(key, lambda v: v in names, meaning, default)
        return chosen

    def array(self, key: str, columns: int | None, meaning: str) -> np.ndarray:
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
        value = self.array(key, None, meaning)
        if len(value) != length:
            raise self.error(key, f"has {len(value)} numbers; give {meaning}")
        return tuple(map(float, value))

    def table(self, key: str) -> "TomlTable":
        value = self.get(key, lambda v: isinstance(v, dict), f"a table [{key}]")
        return TomlTable(value, f"{self.where}: [{key}]", self.allow_import)

    def tables(self, key: str) -> list["TomlTable"]:
        def good(value: Any) -> bool:
            return isinstance(value, list) and all(isinstance(v, dict) for v in value)

        values = self.get(key, good, f"tables [[{key}]]", [])
        where = f"{self.where}: [[{key}]] number"
        return [TomlTable(v, f"{where} {i + 1}", self.allow_import) for i, v in enumerate(values)]

    def done(self) -> None:
        for key in self._values:
            if key not in self._asked:
                near = difflib.get_close_matches(key, self._asked, 1)
                hint = f"did you mean {near[0]!r}?" if near else "known: " + self._known()
                raise self.error(_SHORT.repr(key)[1:-1], f"unknown key; {hint}")

    def _known(self) -> str:
        return ", ".join(sorted(self._asked))


MAX_COUNT = 1_000_000
"""Limit of everything that is counted: electrodes, rows, places."""


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number that a float can hold."""
    return (type(value) is int and abs(value) < 1 << 63) or (type(value) is float and math.isfinite(value))
