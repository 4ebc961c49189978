"""TOML files read key by key: errors name the key that is missing, wrong or unknown, and the reason."""

import difflib
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

__all__ = [
    "TomlError",
    "TomlTable",
    "parse_toml",
    "read_text",
]

T = TypeVar("T")


class TomlError(ValueError):
    """A file that cannot be used; the message names the file, the key and the reason."""


def read_text(path: Path) -> str:
    """The text of a file, or a `TomlError` that names it."""
    try:
        return path.read_text(encoding="utf-8")
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
        return build(TomlTable(tomllib.loads(text), source, allow_import))
    except tomllib.TOMLDecodeError as error:
        raise TomlError(f"{source}: not valid TOML: {error}") from None
    except RecursionError:
        raise TomlError(f"{source}: not valid TOML: nested too deeply") from None
    except TomlError:
        raise
    except ValueError as error:  # an object refused the values it was given
        raise TomlError(f"{source}: {error}") from None


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
            raise self.error(key, f"is {value!r}; give {meaning}")
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
                raise self.error(key, f"unknown key; {hint}")

    def _known(self) -> str:
        return ", ".join(sorted(self._asked))


MAX_COUNT = 1_000_000
"""Limit of everything that is counted: electrodes, rows, places."""


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number that a float can hold."""
    return (type(value) is int and abs(value) < 1 << 63) or (type(value) is float and math.isfinite(value))
