"""Settings: the fields of a class that text can give, with what they accept."""

import enum
import math
import re
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from inspect import cleandoc, isclass, signature
from types import UnionType
from typing import Any, NamedTuple, Protocol, Union, get_args, get_origin, get_type_hints, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import AbstractArray

from ..toml import TomlTable

LARGEST_INT = 2**31 - 1  # what a 32-bit array can hold


@runtime_checkable
class Part(Protocol):
    """What a setting needs of a registry whose objects it holds; see `Registry`."""

    base: type
    kind: str

    def make(self, text: str, allow_import: bool = False) -> Any:
        """The object that a word of the command line describes."""

    def read(self, table: TomlTable) -> Any:
        """The object that a TOML table describes."""

    def settings(self, thing: Any) -> dict[str, Any]:
        """The values of the TOML table from which `read` makes the object again."""

    def text(self, thing: Any) -> str:
        """The word from which `make` makes the object again."""


def computed() -> Any:
    """A field that the class computes itself and that text cannot give; None until then."""
    return eqx.field(default=None, metadata={"computed": True})


class TextForm(NamedTuple):
    """One form that a value may have in text: a test of the value, its description for messages, and its conversion."""

    accepts: Callable[[Any], bool]
    meaning: str
    convert: Callable[[Any], Any]


def _is_number(value: Any) -> bool:
    whole = type(value) is int and abs(value) < 1 << 63
    return whole or (type(value) is float and math.isfinite(value))


BOOLEAN = TextForm(lambda v: type(v) is bool, "true or false", bool)
INTEGER = TextForm(lambda v: type(v) is int and 0 <= v <= LARGEST_INT, "a whole number from 0", int)
NUMBER = TextForm(_is_number, "a number", float)
LIMIT = TextForm(lambda v: type(v) is float and math.isinf(v), "inf", float)
TEXT = TextForm(lambda v: isinstance(v, str), "a text", str)
FORM_OF_DTYPE = {"Bool": BOOLEAN, "Int": INTEGER, "Integer": INTEGER, "UInt": INTEGER}
FORM_OF_TYPE = {bool: BOOLEAN, int: INTEGER, float: NUMBER, str: TEXT}


def _list_of(form: TextForm, rank: int, length: int | None) -> TextForm:
    """Lists of values of this form, nested ``rank`` deep; the values become tuples."""
    if rank == 0:
        return form
    inner = _list_of(form, rank - 1, None)

    def accepts(value: Any) -> bool:
        return isinstance(value, list) and length in (None, len(value)) and all(map(inner.accepts, value))

    meaning = f"[{inner.meaning}, ...]" if length is None else "[" + ", ".join([inner.meaning] * length) + "]"
    return TextForm(accepts, meaning, lambda v: tuple(map(inner.convert, v)))


def _choice_of(kind: type[enum.Enum]) -> TextForm:
    values = [member.value for member in kind]
    return TextForm(lambda v: v in values, "one of " + ", ".join(f'"{v}"' for v in values), kind)


def _forms(hint: Any, default: Any) -> list[TextForm]:
    """The forms of values that an annotation allows; empty if text cannot give such a value."""
    if get_origin(hint) in (Union, UnionType):
        every = [form for part in get_args(hint) for form in _forms(part, default)]
        return sorted(every, key=lambda form: form.meaning.count("["))  # single values before lists
    if get_origin(hint) is tuple:
        return _forms_of_tuple(get_args(hint))
    if not isclass(hint):
        return []
    if issubclass(hint, enum.Enum):
        return [_choice_of(hint)]
    if issubclass(hint, AbstractArray):
        return _forms_of_array(hint)
    if hint in (jax.Array, np.ndarray) and default is not MISSING:
        values = np.asarray(default)
        return [_list_of(FORM_OF_TYPE[type(values.ravel()[0].item())], values.ndim, None)] if values.size else []
    return [FORM_OF_TYPE[hint]] if hint in FORM_OF_TYPE else []


def _forms_of_tuple(parts: tuple[Any, ...]) -> list[TextForm]:
    if not parts or parts[0] not in FORM_OF_TYPE:
        return []
    return [_list_of(FORM_OF_TYPE[parts[0]], 1, None if parts[-1] is Ellipsis else len(parts))]


def _forms_of_array(hint: Any) -> list[TextForm]:
    if "..." in hint.dim_str or "*" in hint.dim_str:
        return []
    kind = FORM_OF_DTYPE.get(hint.dtype.__name__, NUMBER)
    return [_list_of(kind, len(hint.dims), None)]


@dataclass(frozen=True)
class Setting:
    """A field of a class that text can give.

    ``default`` is `MISSING` if the class has none; ``description`` is what the docstring says; ``part`` is the
    registry of the object that the field holds, if it holds one.
    """

    name: str
    forms: tuple[TextForm, ...]
    default: Any
    description: str
    part: Part | None

    def read(self, table: TomlTable) -> Any:
        """The value that a table gives.

        Raises:
            TomlError: for a value of another kind.
        """
        if self.part is not None:
            return self._read_part(table, self.part)
        meaning = " or ".join(form.meaning for form in self.forms) + self._hint()
        value = table.get(self.name, lambda v: any(form.accepts(v) for form in self.forms), meaning)
        return next(form for form in self.forms if form.accepts(value)).convert(value)

    def _hint(self) -> str:
        example = None if self.default is MISSING else self.plain(self.default)
        such = f" such as {word(example)}" if isinstance(example, list) or _is_number(example) else ""
        return such + (f" ({self.description})" if self.description else "")

    def _read_part(self, table: TomlTable, part: Part) -> Any:
        value = table.get(self.name, lambda v: isinstance(v, str | dict), f"a {part.kind}: its name, or a table")
        if isinstance(value, dict):
            return part.read(table.table(self.name))
        try:
            return part.make(value, table.allow_import)
        except ValueError as error:
            raise table.error(self.name, str(error)) from None

    def plain(self, value: Any) -> Any:
        """A value as TOML writes it; None for a field without a value."""
        if value is None or isinstance(value, str):
            return value
        if isinstance(value, enum.Enum):
            return value.value
        return _plain_numbers(np.asarray(value)) if self.part is None else self.part.settings(value)

    def word(self, value: Any) -> str:
        """A value as the command line writes it; an object by its name and settings."""
        return word(self.plain(value)) if self.part is None or value is None else self.part.text(value)

    def is_default(self, value: Any) -> bool:
        """Whether this value is the default of the class."""
        return self.default is not MISSING and self.plain(value) == self.plain(self.default)


def _plain_numbers(array: np.ndarray) -> Any:
    """An array as Python numbers in lists; float32 values keep their short decimal form, 0.1 and not 0.10000000149."""
    if array.dtype == np.float32:
        return np.array([str(number) for number in array.ravel()], dtype=float).reshape(array.shape).tolist()
    return array.tolist()


def word(value: Any) -> str:
    """A plain value as the command line writes it."""
    if isinstance(value, list):
        return "[" + ",".join(map(word, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def settings_of(kind: type, parts: tuple[Part, ...]) -> dict[str, Setting]:
    """The settings of a class, by name."""
    hints, described = get_type_hints(kind), _descriptions(kind)
    out = {}
    for field in fields_of(kind):
        if not field.init or field.metadata.get("computed"):
            continue
        default, hint = _default(field), hints[field.name]
        forms = tuple(_forms(hint, default))
        forms += (LIMIT,) if isinstance(default, float) and math.isinf(default) else ()
        part = next((p for p in parts if _holds(hint, p.base)), None)
        if forms or part is not None:
            out[field.name] = Setting(field.name, forms, default, described.get(field.name, ""), part)
    return out


def fields_of(kind: type) -> tuple["Field[Any]", ...]:
    """The fields of a dataclass; none for a plain class, which may then take no arguments.

    Raises:
        ValueError: for a plain class that takes arguments, since nothing says which of them its objects were made with.
    """
    if is_dataclass(kind):
        return fields(kind)
    if signature(kind).parameters:
        raise ValueError(
            f"{kind.__name__} takes arguments and has no fields, which files keep; write it as a dataclass"
        )
    return ()


def _holds(hint: Any, base: type) -> bool:
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return any(isclass(kind) and kind is not type(None) and issubclass(kind, base) for kind in kinds)


def _default(field: "Field[Any]") -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return field.default


# --- what docstrings say of fields ------------------------------------------------------------------------------------


def _descriptions(kind: type) -> dict[str, str]:
    """The meaning, range and unit of each field, from the table in the docstring of the class.

    A row begins with the field's name, as in ``| length of correlation | 30 | 10 to 60 | mm |``.
    """
    rows = [_cells(line) for line in cleandoc(kind.__doc__ or "").splitlines() if line.startswith("|")]
    if len(rows) < 2:
        return {}
    head, names = rows[0], {field.name for field in fields_of(kind)}
    out = {}
    for row in rows[2:]:
        said = dict(zip(head, row, strict=False))
        text = f"{said.get('range', '')} {said.get('unit', '').removeprefix('1')}".strip()
        for name in re.findall(r"\w+", row[0].partition(":")[0]):
            if name in names and name not in out:
                out[name] = row[0] + (f", {text}" if text else "")
    return out


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]
