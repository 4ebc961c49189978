"""Limits of settings: the values that have a meaning, stated beside the default of a field."""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from .._compile import is_traced

NO_NUMBERS = "SUOMmc"
"""Kinds of arrays of texts, objects, dates and complex numbers."""


LONGEST = 1.0
"""Largest length among settings, m: longer than any skin, and below what a length in mm would be."""


class SettingError(ValueError):
    """A setting outside its limits; the message names the class, the setting and the limits."""


class Limits(NamedTuple):
    """Which numbers have a meaning.

    | meaning                                       |
    |-----------------------------------------------|
    | least, most: smallest and largest             |
    | open: whether the smallest itself is refused  |
    | finite: whether infinite ones are refused     |
    | whole: whether fractions are refused          |
    | unit: of the numbers, for messages            |
    | empty: whether there may be no number at all  |
    """

    least: float = -math.inf
    most: float = math.inf
    open: bool = False
    finite: bool = True
    whole: bool = False
    unit: str = ""
    empty: bool = False

    def outside(self, value: Any) -> np.ndarray:
        """The numbers of a value, an array or a scalar, that have no meaning; all of what holds no real numbers."""
        numbers = np.atleast_1d(np.asarray(value))
        if numbers.dtype.kind in NO_NUMBERS:
            return numbers
        low = numbers > self.least if self.open else numbers >= self.least
        kind = (np.isfinite(numbers) | (not self.finite)) & ((numbers.dtype.kind in "iu") | (not self.whole))
        found: np.ndarray = numbers[~(low & (numbers <= self.most) & kind)]
        return found

    def __str__(self) -> str:
        kind = f"{self.unit and ' '}{self.unit}{', a whole number' if self.whole else ''}"
        if math.isfinite(self.most):
            return f"{'more than ' if self.open else ''}{self.least:g} to {self.most:g}{kind}"
        if math.isfinite(self.least):
            return f"{'more than' if self.open else 'at least'} {self.least:g}{kind}"
        return "a finite number" if self.finite else "a number"


def limited(
    default: Any,
    *,
    least: float = -math.inf,
    above: float | None = None,
    most: float = math.inf,
    finite: bool = True,
    whole: bool | None = None,
    unit: str = "",
    empty: bool = False,
    **options: Any,
) -> Any:
    """A field of a class whose numbers lie from ``least``, or ``above`` a number, to ``most``.

    Args:
        finite: whether infinite numbers are refused.
        whole: whether fractions are refused; by default where the default is a whole number.
        unit: of the numbers, for messages.
        empty: whether there may be no number at all.
        options: of `equinox.field`, such as ``static`` and ``converter``.

    Example:
        from jaxeit.registry import AbstractChoice, limited


        class Firmness(AbstractChoice):  # a choice of your own, with a limit
            share: float = limited(0.5, above=0.0, most=1.0)


        try:
            Firmness(share=2.0)
        except je.registry.SettingError as error:
            print(error)
    """
    whole = type(default) is int if whole is None else whole
    limits = Limits(least if above is None else above, most, above is not None, finite, whole, unit, empty)
    return eqx.field(default=default, metadata={"limits": limits}, **options)


def require_limits(thing: Any, error: type[ValueError] = SettingError) -> None:
    """Refuse an object with a setting outside of its `limited` field, unless jit, grad or vmap hides the value.

    Raises:
        SettingError: or the given ``error``.

    Example:
        from dataclasses import dataclass

        from jaxeit.registry import limited, require_limits


        @dataclass
        class Speed:  # a dataclass with limits
            speed: float = limited(0.1, above=0.0)  # m/s

            def __post_init__(self):
                require_limits(self)
    """
    for field in dataclasses.fields(thing):
        limits, value = field.metadata.get("limits"), getattr(thing, field.name)
        if limits is None or value is None or is_traced(value):
            continue
        if not np.size(value) and not limits.empty:
            raise error(f"{type(thing).__name__}: {field.name} is empty; give {limits}")
        if (wrong := limits.outside(value)).size:
            raise error(f"{type(thing).__name__}: {field.name} is {_shown(wrong, limits)}; give {limits}")


def _shown(wrong: np.ndarray, limits: Limits) -> str:
    """The first of some wrong values, as a message shows it."""
    if wrong.dtype.kind in NO_NUMBERS:
        return repr(wrong.tolist()[0])
    shown = repr(wrong[0].item()) if limits.whole else f"{wrong[0]:g}"  # 16.0 is no whole number
    return shown + (limits.unit and f" {limits.unit}")


class AbstractChoice(eqx.Module):
    """A class that a registry knows by name, whose settings lie within their limits.

    Raises:
        SettingError: for a setting outside of its `limited` field.
    """

    def __check_init__(self) -> None:
        require_limits(self)
