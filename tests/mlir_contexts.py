"""One context of MLIR for many programs, while tests run.

JAX makes a context for each program and loads all dialects into it: 4 ms, half of the time of a program that is in the
cache, for each of the ten thousand programs of the suite.
"""

from threading import local
from typing import Any

from jax._src.interpreters import mlir

MOST_PROGRAMS = 200
"""Programs of one context, which keeps their types and constants."""


class _Contexts(local):
    """The context of each thread."""

    programs = 0
    context: Any = None


def install() -> None:
    """Let JAX use a context again. A version of JAX without this function makes them as ever."""
    make = getattr(mlir, "make_ir_context", None)
    if make is None:
        return
    kept = _Contexts()

    def shared() -> Any:
        if _is_lowering():  # a program within another would become a part of it
            return make()
        if kept.programs % MOST_PROGRAMS == 0:
            kept.context = make()
        kept.programs += 1
        return kept.context

    mlir.make_ir_context = shared


def _is_lowering() -> bool:
    try:
        return mlir.ir.Context.current is not None
    except ValueError:
        return False
