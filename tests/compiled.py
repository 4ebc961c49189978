"""Calls of one compiled program. Called without, a function of JAX compiles each operation that it does."""

from typing import Any

import equinox as eqx


@eqx.filter_jit
def compiled(function: Any, *args: Any) -> Any:
    """The result of a function, or of a method of a module, with arrays as arguments."""
    return function(*args)
