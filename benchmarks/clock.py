"""The clock that every question shares: seconds of calls, tools in turn, agreement before timing, memory, limits."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

MAX_DIFFERENCE = 1e-9  # of results of tools that do the same work, relative to the largest value
TURN_SECONDS = 0.1  # s
MIN_TURNS = 5  # turns: the least and most of fewer times say little about their spread

Tool = Callable[[np.ndarray], np.ndarray]


def seconds(call: Callable, *args: Any) -> tuple[float, Any]:
    """Seconds of a call, and what it returns."""
    start = time.perf_counter()
    out = call(*args)
    return time.perf_counter() - start, out


def taken(tool: Tool, sigma: np.ndarray) -> tuple[float, np.ndarray]:
    """Seconds and result of a tool's call. A tool in another process reads the clock itself, without the transport."""
    outside, out = seconds(tool, sigma)
    return getattr(tool, "last_seconds", outside), out


class Turn(NamedTuple):
    """Seconds of the last call in a turn of a tool, and of the first call, which follows all the other tools."""

    last: float
    first: float


def interleaved(calls: Sequence[tuple[Tool, np.ndarray]], repeats: int, budget: float) -> list[list[Turn]]:
    """Turns of tools with their conductivities, each round in another order, so that none always follows the same one.

    A slow tool stops after ``budget`` seconds, though not before `MIN_TURNS` turns.
    """
    turns: list[list[Turn]] = [[] for _ in calls]
    for number in range(repeats):
        for k in np.random.default_rng(number).permutation(len(calls)):
            if len(turns[k]) < MIN_TURNS or sum(turn.last for turn in turns[k]) < budget:
                tool, sigma = calls[k]
                turns[k].append(a_turn(tool, sigma * (1 + 1e-3 * number)))
    return turns


def a_turn(tool: Tool, sigma: np.ndarray) -> Turn:
    """Seconds of the last and of the first call among those that `TURN_SECONDS` holds; no conductivity occurs twice.

    In the first calls the processor fetches again what other tools have driven from its caches, and the system learns
    that two threads need two cores. A program that calls one tool again and again pays for that once.
    """
    last = first = spent = taken(tool, sigma)[0]
    while spent < TURN_SECONDS:
        last = taken(tool, sigma * (1 + 1e-3 * spent))[0]
        spent += last
    return Turn(last, first)


def in_turns(calls: Mapping[Any, Callable], repeats: int, budget: float = np.inf) -> dict[Any, list[float]]:
    """Seconds of several calls, each once a round; a slow one stops after ``budget`` seconds and `MIN_TURNS` rounds."""
    times: dict[Any, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            if len(times[name]) < MIN_TURNS or sum(times[name]) < budget:
                times[name].append(seconds(call)[0])
    return times


def spread(times: Sequence[float]) -> dict[str, float]:
    """Median, least and most in ms, and the number of repeats."""
    ms = 1e3 * np.array(times)
    summary = {"median_ms": np.median(ms), "min_ms": ms.min(), "max_ms": ms.max()}
    return {key: round(float(value), 4) for key, value in summary.items()} | {"repeats": len(times)}


class Program(NamedTuple):
    """A compiled call without arguments, the seconds that it took to compile, and what XLA says of it."""

    call: Callable[[], Any]
    compile_s: float
    compiled: jax.stages.Compiled


def program(function: Callable, arguments: tuple) -> Program:
    """``function(*arguments)`` compiled with `jaxeit.compiler_options`; arrays in the arguments are no constants."""
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    jitted = jax.jit(lambda arrays: function(*eqx.combine(arrays, rest)), compiler_options=je.compiler_options())
    spent, done = seconds(lambda: jitted.lower(arrays).compile())
    return Program(lambda: jax.block_until_ready(done(arrays)), spent, done)


# --- agreement


def difference(values: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference relative to the largest value."""
    return float(np.abs(values - reference).max() / np.abs(reference).max())


def require_agreement(
    outputs: Mapping[str, np.ndarray], reference: str, loose: Mapping[str, float]
) -> dict[str, float]:
    """Differences of the tools' results from the reference's, which are printed.

    Raises:
        SystemExit: where a tool computes something else; nothing is timed then.
    """
    found = {name: difference(out, outputs[reference]) for name, out in outputs.items() if name != reference}
    for name, value in found.items():
        print(f"  {name} against {reference}: {value:.1e}")
        if not value <= loose.get(name, MAX_DIFFERENCE):
            raise SystemExit(f"{name} disagrees with {reference}: nothing is timed")
    return found


# --- fresh processes, and limits of the machine

CACHE = {  # as the command line sets it, calib/runtime.py
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


def fresh(code: str, cache: str = "") -> tuple[float, str]:
    """Seconds of a fresh Python that runs the code, with a folder of compiled programs or none; and what it prints.

    Python keeps the bytecode of modules, as it does unless told otherwise.
    """
    ours = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_X64", "PYTHONDONTWRITEBYTECODE", *CACHE)
    environment = {name: value for name, value in os.environ.items() if name not in ours}
    environment |= CACHE | {"JAX_COMPILATION_CACHE_DIR": cache} if cache else {}
    how: Any = {"cwd": Path(__file__).parents[1], "env": environment, "capture_output": True, "check": True}
    spent, done = seconds(lambda: subprocess.run([sys.executable, "-c", code], text=True, **how))
    return spent, done.stdout


def limits() -> dict[str, float]:
    """What this machine reaches: flop/s of XLA's matrix product on all cores, byte/s of a copy; best of five."""
    a, big = jnp.asarray(np.random.default_rng(0).random((1500, 1500))), np.ones(1 << 24)
    product, into = jax.jit(jnp.matmul), np.ones_like(big)
    flops = 2 * 1500**3 / min(seconds(lambda: jax.block_until_ready(product(a, a)))[0] for _ in range(5))
    copied = 2 * big.nbytes / min(seconds(np.copyto, into, big)[0] for _ in range(5))
    return {"flop_per_s": flops, "byte_per_s": copied}
