"""Check annotations while tests run, by jaxtyping's import hook with beartype. ``JAXTYPING_DISABLE=1`` leaves it out.

jaxtyping checks every function twice: its parameters before a call, and its parameters and result after the call. The
first check is left out here, so that a function may refuse what its annotations exclude with an error of its own: an
annotation is false if the function accepts more than the annotation says.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import partial, wraps
from inspect import isclass
from typing import Any, Self, get_args, get_origin

import jax
import jaxtyping
import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import BeartypeDecorHintPepUnsupportedException
from numpy.typing import ArrayLike

_AS: dict[Any, Any] = {
    # The functions that jaxtyping checks are in no class that Self could stand for.
    Self: Any,
    # A session's mapping reads an array from the file when asked for it, and the file may be damaged there.
    Mapping[str, np.ndarray]: Mapping,
    # The sequences in NumPy's ArrayLike are a protocol; tuples lack one of its methods and are sequences all the same.
    **{part: Sequence for part in get_args(ArrayLike) if "_NestedSequence" in repr(get_origin(part))},
}
if hasattr(ArrayLike, "__value__"):  # an alias since NumPy 2.5
    _AS[ArrayLike] = np.ndarray | np.generic | jax.Array | Sequence | complex
# An int is a float, as for mypy.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict(_AS)))


_check_now = jaxtyping.jaxtyped

MOST_CHECKS = 4
"""Checked calls of a function in one test: a loop calls it with the same shapes again, and a check takes longer than
many a function."""

_now = 0  # number of the test that runs


def begin_test() -> None:
    """From here on, each function is checked anew."""
    global _now
    _now += 1


def install() -> None:
    """Check the functions and dataclasses of the packages; to be called before the packages are imported.

    A conftest does that. Workers of pytest-xdist import the plugins named by ``-p`` after the conftest.
    """
    if not jaxtyping.config.jaxtyping_disable:
        jaxtyping.jaxtyped = checked_when_called
        jaxtyping.install_import_hook(["jaxeit", "calib"], "tests.annotations.after_the_call")


def checked_when_called(item: Any = None, *, typechecker: Callable[..., Any]) -> Any:
    """jaxtyping's decorator, applied at the first call, since a test calls few of the functions that it imports.

    Functions inside functions are left out: their checks would be compiled at every call of the outer one.
    """
    if item is None:
        return partial(checked_when_called, typechecker=typechecker)
    if "<locals>" in item.__qualname__:
        return item
    if isclass(item):
        if is_dataclass(item) and not hasattr(item.__init__, "__wrapped__"):
            item.__init__ = checked_when_called(item.__init__, typechecker=typechecker)
        return item
    checked: list[Callable[..., Any]] = []
    test, count = 0, 0

    @wraps(item)
    def call(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal test, count
        test, count = _now, count + 1 if test == _now else 1
        if count > MOST_CHECKS:
            return item(*args, **kwargs)
        if not checked:
            checked.append(_check_now(item, typechecker=typechecker))
        return checked[0](*args, **kwargs)

    return call


def after_the_call(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with beartype's check, if jaxtyping made the function for the check after a call."""
    if not _has_result(function):
        return function
    try:
        return _beartype(function)
    except BeartypeDecorHintPepUnsupportedException:  # such as a generic named tuple, for which beartype has no check
        return function


def _has_result(function: Callable[..., Any]) -> bool:
    """Whether jaxtyping made this function for the check after a call: the result is its last keyword."""
    code = function.__code__
    return any(name.startswith("ret") for name in code.co_varnames[code.co_argcount :][: code.co_kwonlyargcount])
