"""What stands in the place of something else: a name, a path, a class, or an object of another kind."""

import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

__all__ = ["is_number", "listed", "require_kind", "require_unmasked", "shown", "stated"]


def stated(value: Any) -> str:
    """How a message names a value: a text or path as it is written, a class as such, another object by its class."""
    if isinstance(value, str | os.PathLike):
        return repr(os.fspath(value))
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def is_number(value: Any) -> bool:
    """Whether a value is one real number, of Python, NumPy or JAX; a text, None and True are none."""
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"


def shown(value: Any) -> str:
    """A wrong number as a message shows it: a text in quotes, which looks like a number otherwise."""
    return str(value) if is_number(value) else repr(value)


def listed(names: Iterable[str]) -> str:
    """Names with commas between them; in quotes if one of them holds a comma, so that none looks like two."""
    known = list(names)
    return ", ".join(map(repr, known) if any("," in name for name in known) else known)


def require_kind(
    value: Any, kinds: type | tuple[type, ...], error: type[Exception], what: str, give: str, where: str = ""
) -> None:
    """Refuse a value that is none of some classes.

    Args:
        kinds: the classes.
        error: type of the error.
        what: what the value should be, such as "a prior".
        give: what the user should give.
        where: name of the call or of the setting.

    Raises:
        error: "<where>: <value> is not <what>; give <give>".
    """
    if not isinstance(value, kinds):
        raise error(f"{where}{where and ': '}{stated(value)} is not {what}; give {give}")


def require_unmasked(given: Mapping[str, Any], error: type[Exception], fill: str = "numpy.nan") -> None:
    """Refuse arrays of `numpy.ma`: an array of NumPy would hold what they mask as if measured, and JAX takes none.

    Args:
        given: the values by their names.
        error: type of the error.
        fill: what stands for a missing value here.

    Raises:
        error: "<name> is a masked array, whose mask would be lost; give <name>.filled(<fill>)".
    """
    for name, values in given.items():
        if np.ma.isMaskedArray(values):
            raise error(f"{name} is a masked array, whose mask would be lost; give {name}.filled({fill})")
