"""Kinds of loads in one table of parameters, and the pressure of loads.

Each load has six parameters: x, y, log width s, log force, and half its length along x and along y. A round load has no
length. One table of parameters for all kinds of loads means one compiled program for all of them; which rows count,
and how, is an array of `LoadForm`. What kinds there are, and of which forms, is in `FORMS` alone.
"""

import math
from collections.abc import Callable
from enum import IntEnum
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float, Int

from .result import LoadKind
from .spreading import Spreading


class LoadForm(IntEnum):
    """What a row of parameters stands for."""

    ABSENT = 0
    ROUND = 1
    LONG = 2

    @property
    def parameters(self) -> int:
        """Number of parameters of such a row that count, which are the first ones."""
        return (0, 4, 6)[self]


# Forms of the loads of each kind; a proposal's network tells the kinds in this order.
FORMS = {
    LoadKind.ONE: (LoadForm.ROUND,),
    LoadKind.TWO: (LoadForm.ROUND, LoadForm.ROUND),
    LoadKind.EDGE: (LoadForm.LONG,),
    LoadKind.MORE: (LoadForm.ROUND, LoadForm.ROUND, LoadForm.ROUND),
}
MAX_LOADS, LOAD_PARAMETERS = max(map(len, FORMS.values())), max(form.parameters for form in LoadForm)  # of each load
FORCE_INDEX = 3  # of the log of the force among these
LINE_POINTS = (-0.8, 0.0, 0.8)  # places of the round loads that stand for an edge, over its half length
LINE_POINT_OFFSET = np.array([0, 0, 0, np.log(len(LINE_POINTS)), 0, 0])  # of the edge's parameters over theirs
SQRT_2, SQRT_3 = math.sqrt(2), math.sqrt(3)
ELONGATION_STD = 0.3  # standard deviation of second moments over that of the others

Parameters = Float[Array, "n 6"]
Forms = Int[Array, " n"]


def pad_rows(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "n 6"]:
    """Pad the parameters of loads to all rows, by repetition of the last one."""
    rows = np.pad(rows, ((0, 0), (0, LOAD_PARAMETERS - rows.shape[1])))
    return np.concatenate([rows, np.repeat(rows[-1:], MAX_LOADS - len(rows), 0)])


def padded_forms(kind: LoadKind) -> Int[np.ndarray, " n"]:
    """Forms of all rows of a kind of loads."""
    forms = FORMS[kind]
    return np.array(forms + (LoadForm.ABSENT,) * (MAX_LOADS - len(forms)), np.int32)


def free_parameters(forms: Int[np.ndarray, " n"]) -> Bool[np.ndarray, "n 6"]:
    """Which parameters of all rows are fitted."""
    free: np.ndarray = np.arange(LOAD_PARAMETERS) < np.array([form.parameters for form in LoadForm])[forms][:, None]
    return free


def pressure(
    loads: Parameters, forms: Forms, points: Float[Array, "... 2"], spreading: Spreading
) -> Float[Array, "..."]:
    """Pressure of all loads at points, Pa."""
    kinds = (_no_pressure, partial(spreading.pressure, spot), partial(spreading.pressure, line))
    return jnp.stack([jax.lax.switch(form, kinds, load, points) for load, form in zip(loads, forms, strict=True)]).sum(
        0
    )


def _no_pressure(load: Float[Array, "6"], points: Float[Array, "... 2"]) -> Float[Array, "..."]:
    return jnp.zeros(points.shape[:-1], points.dtype)


def spot(load: Float[Array, "6"], points: Float[Array, "... 2"]) -> Float[Array, "..."]:
    """Pressure of a round load: Gaussian."""
    variance = jnp.exp(2 * load[2])
    square = jnp.sum((points - load[:2]) ** 2, -1)
    return jnp.exp(load[3] - 0.5 * square / variance) / (2 * jnp.pi * variance)


def line(load: Float[Array, "6"], points: Float[Array, "... 2"], min_half: float = 1e-5) -> Float[Array, "..."]:
    """Pressure of an edge: even along a line, blurred by a Gaussian; of a length near zero, a Gaussian.

    Half a line is at least `min_half`, m, since a length of zero has no direction.
    """
    width, half = jnp.exp(load[2]), jnp.sqrt(load[4:] @ load[4:] + min_half**2)
    offset = points - load[:2]
    along = offset @ load[4:] / half
    across = jnp.sum(offset**2, -1) - along**2
    root = jnp.sqrt(2.0) * width
    spread = (erf((along + half) / root) - erf((along - half) / root)) / (4 * half)
    return jnp.exp(load[3] - 0.5 * across / width**2) * spread / (jnp.sqrt(2 * jnp.pi) * width)


def shape_directions(loads: Parameters, forms: Forms, points: Float[Array, "... 2"]) -> Float[Array, "... d"]:
    """Change of pressure by each moment by which a round load may differ from a Gaussian; an edge is a row of such.

    With ``u = (x - x0) / s`` and ``r = |u|^2 / 2`` they are the Gaussian times the orthonormal polynomials of lowest
    order that change neither force, place nor width: ``L2(r)`` and ``L3(r)`` (flat punch, ring, long tails), which are
    those of all loads; ``u (r - 2) / sqrt(2)`` (tilted tip) and, times `ELONGATION_STD`, ``(u_x^2 - u_y^2) / 2`` and
    ``u_x u_y`` (tilted or elliptic tip), which each load has of its own. A flat disc has moments of -1/3 in L2 and L3,
    a ring -1/2 and -2/3; what the pad spreads has less.
    """
    by_load = _sum_along_line(_shape_moments, loads, forms, points)
    return jnp.concatenate([by_load[..., :2].sum(0), *by_load[..., 2:]], -1)


def even_moments(count: int) -> Bool[np.ndarray, " d"]:
    """Which of so many moments of `shape_directions` are equal at opposite places, so that they move no load."""
    of_load = np.array([False, False, True, True])
    return np.append([True, True], np.tile(of_load, max(count - 2, 0) // 4))[:count]


def tilt_directions(loads: Parameters, forms: Forms, points: Float[Array, "... 2"]) -> Float[Array, "... d"]:
    """Change of pressure by the moments of next order by which a tilted tip differs from a Gaussian, two for each load.

    They are the Gaussian times ``u (3 - 3 r + r^2 / 2) / sqrt(3)``, in the notation of `shape_directions`.
    """
    return jnp.concatenate([*_sum_along_line(_tilt_moments, loads, forms, points)], -1)


def _sum_along_line(
    change: Callable[[Array, Array], Array], loads: Parameters, forms: Forms, points: Float[Array, "... 2"]
) -> Float[Array, "n ... d"]:
    """Changes of pressure by each load; an edge is a row of round loads."""
    rows = [
        (form, load.at[:2].add(t * load[4:]) - LINE_POINT_OFFSET)
        for form, load in zip(forms, loads, strict=True)
        for t in LINE_POINTS
    ]
    found = [jnp.where(form > LoadForm.ABSENT, change(load, points), 0) for form, load in rows]
    return jnp.stack(found).reshape(len(loads), len(LINE_POINTS), *found[0].shape).sum(1)


def _tilt_moments(load: Float[Array, "6"], points: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    u = (points - load[:2]) * jnp.exp(-load[2])
    r = 0.5 * jnp.sum(u**2, -1, keepdims=True)
    return spot(load, points)[..., None] * u * (3 - 3 * r + r**2 / 2) / SQRT_3


def _shape_moments(load: Float[Array, "6"], points: Float[Array, "... 2"]) -> Float[Array, "... 6"]:
    return spot(load, points)[..., None] * _polynomials((points - load[:2]) * jnp.exp(-load[2]))


def _polynomials(u: Float[Array, "... 2"]) -> Float[Array, "... 6"]:
    """The polynomials of `shape_directions` at places in units of the width: two for all loads, four for each."""
    x, y = u[..., 0], u[..., 1]
    r = 0.5 * (x**2 + y**2)
    radial, tilt = [1 - 2 * r + r**2 / 2, 1 - 3 * r + 1.5 * r**2 - r**3 / 6], (r - 2) / SQRT_2
    return jnp.stack([*radial, x * tilt, y * tilt, ELONGATION_STD * 0.5 * (x**2 - y**2), ELONGATION_STD * x * y], -1)


def line_shapes(load: Float[Array, "6"], points: Float[Array, "... 2"], min_half: float) -> Float[Array, "... 6"]:
    """Change of pressure by each moment by which an edge, or a round load, may differ from that of `line`.

    The polynomials are those of `shape_directions`, in units of the standard deviation along the edge and across it:
    along the edge the variance is larger by a third of the square of its half length.
    """
    variance, square = jnp.exp(2 * load[2]), load[4:] @ load[4:] + min_half**2
    offset = points - load[:2]
    shrink = (jnp.sqrt(variance / (variance + square / 3)) - 1) / square
    moved = offset + (shrink * (offset @ load[4:]))[..., None] * load[4:]
    return line(load, points, min_half)[..., None] * _polynomials(moved * jnp.exp(-load[2]))


def elongations(load: Float[Array, "6"], points: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Change of pressure of a round load by second moments: half of those along x minus along y, and of x and y."""
    return _shape_moments(load, points)[..., -2:] / ELONGATION_STD
