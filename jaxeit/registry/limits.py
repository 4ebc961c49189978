"""Limits of settings: the values that have a meaning, stated beside the default of a field."""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from .._compile import is_traced

NO_NUMBERS = "SUOMmc"
"""Kinds of arrays of texts, objects, dates and complex numbers."""


ONE_NUMBER = (int, float, int | None, float | None)
"""Annotations of fields that hold one number."""

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
    | open_end: whether the largest is refused      |
    | size: how many numbers there are; None: any   |
    """

    least: float = -math.inf
    most: float = math.inf
    open: bool = False
    finite: bool = True
    whole: bool = False
    unit: str = ""
    empty: bool = False
    open_end: bool = False
    size: int | None = None

    def outside(self, value: Any) -> np.ndarray:
        """The numbers of a value, an array or a scalar, that have no meaning; all of what holds no real numbers."""
        try:
            numbers = np.atleast_1d(np.asarray(value))
        except ValueError:  # rows of unequal lengths
            return np.array([str(value)])
        if numbers.dtype.kind in NO_NUMBERS:
            return numbers
        low = numbers > self.least if self.open else numbers >= self.least
        kind = (np.isfinite(numbers) | (not self.finite)) & ((numbers.dtype.kind in "iu") | (not self.whole))
        high = numbers < self.most if self.open_end else numbers <= self.most
        found: np.ndarray = numbers[~(low & high & kind)]
        return found

    def __str__(self) -> str:
        several = "" if self.size is None else f", {self.size} numbers"
        kind = f"{self.unit and ' '}{self.unit}{', a whole number' if self.whole else ''}{several}"
        if math.isfinite(self.most):
            end = f"{'less than ' if self.open_end else ''}{self.most:g}"
            return f"{'more than ' if self.open else ''}{self.least:g} to {end}{kind}"
        if math.isfinite(self.least):
            return f"{'more than' if self.open else 'at least'} {self.least:g}{kind}"
        return "a finite number" if self.finite else "a number"


def limited(
    default: Any,
    *,
    least: float = -math.inf,
    above: float | None = None,
    most: float = math.inf,
    below: float | None = None,
    finite: bool = True,
    whole: bool | None = None,
    unit: str = "",
    empty: bool = False,
    size: int | None = None,
    **options: Any,
) -> Any:
    """A field of a class whose numbers lie from ``least``, or ``above`` a number, to ``most``, or ``below`` a number.

    Args:
        finite: whether infinite numbers are refused.
        whole: whether fractions are refused; by default where the default is a whole number.
        unit: of the numbers, for messages.
        empty: whether there may be no number at all.
        size: how many numbers there are; default: any, and one where the annotation is ``int`` or ``float``.
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
    ends = least if above is None else above, most if below is None else below
    limits = Limits(*ends, above is not None, finite, whole, unit, empty, below is not None, size)
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
        if np.ndim(value) and field.type in ONE_NUMBER:
            raise error(f"{type(thing).__name__}: {field.name} has shape {np.shape(value)}; give one number, {limits}")
        if limits.size is not None and np.shape(value) != (limits.size,):
            raise error(f"{type(thing).__name__}: {field.name} has shape {np.shape(value)}; give {limits}")


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
