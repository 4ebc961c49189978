"""Check annotations while tests run, by jaxtyping's import hook with beartype.

A plugin, to be loaded before the packages: ``python -m pytest -n 0 -p tests.annotations tests/fitting``;
workers of pytest-xdist would load it too late.

jaxtyping checks every function twice: its parameters before a call, and its parameters and result after the call. The
first check is left out here, so that a function may refuse what its annotations exclude with an error of its own: an
annotation is false if the function accepts more than the annotation says.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self, get_args, get_origin

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import BeartypeDecorHintPepUnsupportedException
from jaxtyping import install_import_hook
from numpy.typing import ArrayLike

_AS = {
    # The functions that jaxtyping checks are in no class that Self could stand for.
    Self: Any,
    # A session's mapping reads an array from the file when asked for it, and the file may be damaged there.
    Mapping[str, np.ndarray]: Mapping,
    # The sequences in NumPy's ArrayLike are a protocol; tuples lack one of its methods and are sequences all the same.
    **{part: Sequence for part in get_args(ArrayLike) if "_NestedSequence" in repr(get_origin(part))},
}
# An int is a float, as for mypy.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=FrozenDict(_AS)))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """beartype on first use, since most of the functions that a test file imports are not called.

    Functions inside functions are left out: they would be compiled at every call of the outer one.
    """
    if "<locals>" in function.__qualname__ or not _has_result(function):
        return function
    compiled: list[Callable[..., Any]] = []

    def check(*args: Any, **kwargs: Any) -> Any:
        if not compiled:
            compiled.append(_compiled(function))
        return compiled[0](*args, **kwargs)

    return check


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its check; without one where beartype knows no check, such as for a generic named tuple."""
    try:
        return _beartype(function)
    except BeartypeDecorHintPepUnsupportedException:
        return function


def _has_result(function: Callable[..., Any]) -> bool:
    """Whether jaxtyping made this function for the check after a call: the result is its last keyword."""
    code = function.__code__
    return any(name.startswith("ret") for name in code.co_varnames[code.co_argcount :][: code.co_kwonlyargcount])


install_import_hook(["jaxeit", "calib"], "tests.annotations.checked")
