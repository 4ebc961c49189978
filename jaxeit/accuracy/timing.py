"""Times of compiled programs, measured in turn so that a busy moment of the machine affects all programs alike."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from .._compile import compiler_options
from .recommendation import Times

T = TypeVar("T")
Progress = Callable[[Iterable[Any]], Iterable[Any]]

MIN_CALLS, MAX_CALLS = 3, 1000  # timed calls of each program


@dataclass(frozen=True, eq=False)
class Program:
    """A compiled function of one argument, the seconds of its compilation, and the memory that it needs, bytes."""

    run: Callable[[Any], Any]
    seconds: float
    memory: int | None


def compiled(function: Callable[..., Any], fixed: Any, varying: Any) -> Program:
    """``function(fixed, varying)`` as a program of ``varying``, with the time of its compilation."""
    arrays, rest = eqx.partition(fixed, eqx.is_array)
    program = jax.jit(
        lambda arrays, varying: function(eqx.combine(arrays, rest), varying), compiler_options=compiler_options()
    )
    seconds, done = clocked(lambda: program.lower(arrays, varying).compile())
    sizes = done.memory_analysis()
    memory = sizes and sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return Program(finished(partial(done, arrays)), seconds, memory)


def clocked(call: Callable[[], T]) -> tuple[float, T]:
    """Seconds that a call takes, and its result."""
    start = time.perf_counter()
    out = call()
    return time.perf_counter() - start, out


def finished(call: Callable[[Any], T]) -> Callable[[Any], T]:
    """``call``, but it returns only when the device has computed the result."""

    def run(given: Any) -> T:
        out: T = jax.block_until_ready(call(given))
        return out

    return run


def in_turn(call: Callable[[Any], Any], inputs: Iterable[Any]) -> Callable[[], Any]:
    """A function that calls ``call`` with the next input each time and cycles through the inputs."""
    given = cycle(inputs)
    return lambda: call(next(given))


def timed_in_rounds(calls: Sequence[Callable[[], Any]], budget: float, progress: Progress) -> list[Times]:
    """Times of each call, made in turn, round after round, after a first call of each that is not timed.

    Args:
        calls: without arguments.
        budget: seconds for each call; `MIN_CALLS` are made in any case, and no more than `MAX_CALLS`.
        progress: wraps the rounds.
    """
    for call in calls:
        call()
    taken: list[list[float]] = [[] for _ in calls]
    left = [budget] * len(calls)
    for turn in progress(range(MAX_CALLS)):
        going = [i for i in range(len(calls)) if turn < MIN_CALLS or left[i] > 0]
        for i in going:
            taken[i].append(clocked(calls[i])[0])
            left[i] -= taken[i][-1]
        if not going:
            break
    return [_times(seconds) for seconds in taken]


def _times(seconds: Sequence[float]) -> Times:
    least, median, late = np.quantile(seconds, [0, 0.5, 0.99]).tolist()
    return Times(median, least, late, len(seconds))
