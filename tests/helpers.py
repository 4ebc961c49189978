"""Small skins whose answers are known."""

import gc
import math
import os
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr

import jaxeit as je
from jaxeit.effects import Sheet
from jaxeit.linalg import Dense
from jaxeit.linalg.lapack import CUTS_STACKS

# Recordings of others, which are not part of this project; tests that need them skip where they are not at hand.
REAL_DATA = Path(os.environ.get("JAXEIT_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
MOST_MAPS = 40_000


def bound_maps():
    """Forget compiled programs: one takes some 14 memory maps, of which Linux allows a process 65,530; beyond them XLA
    crashes. Done after each module, and in modules that compile more than so many."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


def compiled(function):
    """As verbs are, which takes half the time of `equinox.filter_jit`; for programs without derivatives, some of which
    XLA 0.10 gets wrong with these options where it optimises nothing else."""
    return eqx.filter_jit(function, compiler_options=je.compiler_options())


def stand_in(kind, **values):
    """An object of a class that has these attributes, whatever the class requires or computes."""
    return object.__new__(type(kind)(kind.__name__, (kind,), values))


def skin_of(domain, electrodes, pattern, *, sheet_resistance=1.0, current=1.0, pads=()):
    """A bare skin; unit sheet resistance and current unless said otherwise."""
    protocol = je.Protocol(np.asarray(pattern), current)
    return je.Skin("test", domain, sheet_resistance, tuple(electrodes), protocol, pads)


def square_model(points, pattern, cells, *, order=1, dtype="float64", ground=None, solver=None, effects=()):
    """The 0.2 m square with point electrodes on a structured mesh of ``cells`` a side."""
    square = je.Rectangle(0.2, 0.2)
    skin = skin_of(square, [je.PointElectrode(p) for p in points], pattern)
    mesh = je.meshing.structured(square, cells, cells)
    fidelity = je.Fidelity(order=order, dtype=dtype, solver=solver or Dense())
    return je.discretise(je.Scene(skin, effects), fidelity, mesh=mesh, ground=ground)


def disc_model(z, edge_length, *, electrodes=16, cover=0.5, order=1, pattern=None):
    """The unit disc with ``electrodes`` boundary patches that cover half the rim."""
    width = 2 * np.pi * cover / electrodes
    starts = 2 * np.pi * np.arange(electrodes) / electrodes - width / 2
    patches = [je.BoundaryPatch(float(s), float(s + width), z) for s in starts % (2 * np.pi)]
    pattern = [[0, 1, 0, 1]] if pattern is None else pattern
    skin = skin_of(je.Disc(1.0), patches, pattern)
    return je.discretise(je.Scene(skin), je.Fidelity(edge_length=edge_length, order=order, solver=Dense()))


def sheet_of(sigma, places, pressure=None, temperature=0.0):
    """A sheet of elements of 1 mm2 at ``places``."""
    pressure = jnp.zeros_like(sigma) if pressure is None else pressure
    return Sheet(sigma, pressure, places, jnp.full_like(sigma, 1e-3), jnp.asarray(temperature))


def require_identical(found, expected):
    """Bit by bit; but a GPU adds numbers in an order of its own, another one in each call."""
    if jax.devices()[0].platform == "cpu":
        np.testing.assert_array_equal(found, expected)
    else:
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.nanmax(np.abs(expected)))


def equations(jaxpr, branches=True):
    """Every operation of a program, in loops and calls as well; without branches, those that run in any case."""
    for equation in jaxpr.eqns:
        yield equation
        inside = list(equation.params.values()) if branches or equation.primitive.name != "cond" else []
        for part in jax.tree.leaves(inside, is_leaf=_is_program):
            if _is_program(part):
                yield from equations(getattr(part, "jaxpr", part), branches)


def products(jaxpr):
    """Every product of arrays in a program."""
    return (equation for equation in equations(jaxpr) if equation.primitive.name == "dot_general")


def _is_program(part):
    return isinstance(part, (Jaxpr, ClosedJaxpr))


_LAPACK = re.compile(r"custom_call @lapack_([a-z]+)_ffi.*? : \((.*?)\) ->")
_OPERATIONS = {"syevd": 5, "gesdd": 10}


def spread_stacks(lowered):
    """LAPACK calls of a lowered program that this jaxlib would spread over threads, see `jaxeit.linalg.lapack`."""
    return large_stacks(lowered) if CUTS_STACKS else []


def large_stacks(lowered):
    """LAPACK calls of a lowered program that jaxlib 0.10 would spread over threads."""
    found = []
    for call, operands in _LAPACK.findall(lowered):
        shapes = [[int(n) for n in shape.split("x")[:-1]] for shape in re.findall(r"tensor<([^>]*)>", operands)]
        stack, rows = math.prod(shapes[0][:-2]), shapes[0][-2]
        columns = max(shape[-1] for shape in shapes if len(shape) >= 2)
        work = stack * _OPERATIONS.get(call[1:], 1) * rows**2 * max(rows, columns)
        if stack > 1 and work > 200_000:
            found.append((call, shapes))
    return found
