"""cuDSS, NVIDIA's direct solver for sparse matrices, for a uniform batch: many matrices of one pattern at once.

By ctypes, on arrays of JAX, so that the clock sees no copy. ``pip install nvidia-cudss-cu13`` installs the library;
``CUDSS_LIBRARY`` names it elsewhere.
"""

import ctypes
import os
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..problems import Problem
from .assembly import DirectForward

NAME = "cuDSS, uniform batch"

# Of cudss_data_types.h and library_types.h.
_ANALYSIS, _FACTORISATION, _REFACTORISATION, _SOLVE = 3, 4, 8, 0b1111110000
_INT32, _FLOATS = 10, {"float32": 0, "float64": 1}
_SPD, _UPPER, _ZERO_BASED, _COLUMN_MAJOR = 3, 2, 0, 0
_UBATCH_SIZE = 18
_Pointer, _Long, _Int = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int


def missing() -> str | None:
    """Why it cannot run here."""
    if all(device.platform == "cpu" for device in jax.devices()):
        return "it needs a GPU"
    return None if _path() else "nvidia-cudss-cu13 is not installed"


def _path() -> str | None:
    if "CUDSS_LIBRARY" in os.environ:
        return os.environ["CUDSS_LIBRARY"]
    packages = find_spec("nvidia")
    folders = [Path(folder) for folder in (packages.submodule_search_locations or ())] if packages else []
    return next((str(found) for folder in folders for found in folder.glob("cu*/lib/libcudss.so.*")), None)


@cache
def _library() -> ctypes.CDLL:
    path = _path()
    assert path is not None
    return ctypes.CDLL(path)


def _call(name: str, *arguments: Any) -> None:
    """A function of cuDSS.

    Raises:
        RuntimeError: if its status is not success.
    """
    if status := getattr(_library(), name)(*arguments):
        raise RuntimeError(f"{name} returned status {status}")


class _Batch:
    """Matrices of one pattern with their factors, and as many sets of right-hand sides."""

    def __init__(self, starts: jax.Array, columns: jax.Array, values: jax.Array, rhs: jax.Array) -> None:
        batch, count = values.shape
        sides, size = rhs.shape[1:]  # by columns
        kind = _FLOATS[str(values.dtype)]
        self.arrays = starts, columns, values, rhs, jnp.zeros_like(rhs)
        self.handle, self.config, self.data = _Pointer(), _Pointer(), _Pointer()
        self.matrix, self.sides, self.solution = _Pointer(), _Pointer(), _Pointer()
        _call("cudssCreate", ctypes.byref(self.handle))
        _call("cudssConfigCreate", ctypes.byref(self.config))
        number = _Int(batch)
        _call("cudssConfigSet", self.config, _UBATCH_SIZE, ctypes.byref(number), ctypes.c_size_t(ctypes.sizeof(number)))
        _call("cudssDataCreate", self.handle, ctypes.byref(self.data))
        where = [_Pointer(array.unsafe_buffer_pointer()) for array in self.arrays]
        form = (_INT32, _INT32, kind, _SPD, _UPPER, _ZERO_BASED)
        lengths = (_Long(size), _Long(size), _Long(count))
        _call("cudssMatrixCreateCsr", ctypes.byref(self.matrix), *lengths, where[0], None, *where[1:3], *form)
        for wrapper, place in ((self.sides, where[3]), (self.solution, where[4])):
            lengths = (_Long(size), _Long(sides), _Long(size))
            _call("cudssMatrixCreateDn", ctypes.byref(wrapper), *lengths, place, kind, _COLUMN_MAJOR)
        for phase in (_ANALYSIS, _FACTORISATION, _SOLVE):
            self._execute(phase)

    def _execute(self, phase: int) -> None:
        _call("cudssExecute", self.handle, phase, self.config, self.data, self.matrix, self.solution, self.sides)

    def close(self) -> None:
        """Give the memory back."""
        for wrapper in (self.matrix, self.sides, self.solution):
            _call("cudssMatrixDestroy", wrapper)
        _call("cudssDataDestroy", self.handle, self.data)
        _call("cudssConfigDestroy", self.config)
        _call("cudssDestroy", self.handle)

    def solve(self, values: jax.Array) -> jax.Array:
        """The solutions for other values, on the device; the next call overwrites them."""
        jax.block_until_ready(values)
        _call("cudssMatrixSetValues", self.matrix, _Pointer(values.unsafe_buffer_pointer()))
        self._execute(_REFACTORISATION)
        self._execute(_SOLVE)
        _synchronise()
        return self.arrays[4]


@cache
def _runtime() -> ctypes.CDLL:
    """The CUDA runtime that JAX has loaded, or another of that version."""
    with open("/proc/self/maps", encoding="ascii") as maps:
        loaded = next((line.split()[-1] for line in maps if "libcudart.so" in line), "libcudart.so.13")
    return ctypes.CDLL(loaded)


def _synchronise() -> None:
    if status := _runtime().cudaDeviceSynchronize():
        raise RuntimeError(f"CUDA reports error {status}")


class Forward:
    """Readings of a batch of conductivities; assembly and readings are two programs of JAX, cuDSS stands between."""

    def __init__(self, problem: Problem, batch: int, dtype: str) -> None:
        by_hand = DirectForward(problem, lambda matrix: lambda rhs: rhs)
        # The matrix is symmetric: its columns are rows, of which cuDSS gets the upper triangle.
        rows, columns = by_hand.matrix.indices, np.repeat(np.arange(len(by_hand.free)), np.diff(by_hand.matrix.indptr))
        self.upper = np.flatnonzero(rows >= columns)
        counts = np.bincount(columns[self.upper], minlength=len(by_hand.free))
        spread = by_hand.spread[self.upper].tocoo()
        element, entry, share = spread.col, spread.row, jnp.asarray(spread.data, dtype)
        size = len(self.upper)

        @jax.jit
        def assembled(sigma: jax.Array) -> jax.Array:
            return jax.vmap(lambda one: jnp.zeros(size, dtype).at[entry].add(share * one[element]))(sigma)

        source, sink, plus, minus = problem.pattern.T
        electrodes = by_hand.rows

        @jax.jit
        def readings(solution: jax.Array) -> jax.Array:
            z = solution[:, :, electrodes]  # by the electrode of the current, then that of the voltage
            return z[:, source, plus] - z[:, source, minus] - z[:, sink, plus] + z[:, sink, minus]

        self.assembled, self.readings = assembled, readings
        starts = jnp.asarray(np.concatenate([[0], np.cumsum(counts)]), jnp.int32)
        ones = jnp.ones((batch, len(problem.sigma)), dtype)
        rhs = jnp.broadcast_to(jnp.asarray(by_hand.rhs.T, dtype), (batch, *by_hand.rhs.T.shape)) + 0
        values = jax.block_until_ready(assembled(ones))
        self.batch = _Batch(starts, jnp.asarray(rows[self.upper], jnp.int32), values, jax.block_until_ready(rhs))

    def __call__(self, sigma: jax.Array) -> jax.Array:
        return jax.block_until_ready(self.readings(self.batch.solve(self.assembled(sigma))))
