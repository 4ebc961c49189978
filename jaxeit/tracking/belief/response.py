"""The measurement model of contacts: readings and pad forces, with derivatives.

Contacts are loads, which add as pressure; the law of the contact layer turns pressure times gain into conductivity. The
first order of the readings is that of an image on a fine mesh, what is beyond it is solved anew on a coarse mesh under
the contacts (`reanalysis`). Derivatives follow the same chain by hand, so that an evaluation solves once.
"""

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float, Int

from ...contacts.loads.pressure import line, line_shapes
from ...contacts.loads.spreading import Spreading
from ...effects.material import ContactPiezoresistance
from .reanalysis import Reanalysis

# Smallest half length, m: an edge of length zero has no direction.
MIN_HALF_LENGTH = 1e-4
# Pressure of all loads: from points (n, 2) to their pressure (n,) and its slopes (a, n).
Pressures = Callable[[Array], tuple[Array, Array]]
# Half lengths, m, and number of directions of the edges whose neighbours are looked up.
EDGE_HALF_LENGTHS, EDGE_DIRECTIONS = (0.015, 0.03), 4


class Neighbourhood(NamedTuple):
    """Elements (e,), their unknowns (m,), and pixels (n,) under and around contacts.

    ``own`` of elements and pixels is false for one that also occurs before, near another contact.
    """

    elements: Int[Array, " e"]
    unknowns: Int[Array, " m"]
    pixels: Int[Array, " n"]
    own_elements: Bool[Array, " e"]
    own_pixels: Bool[Array, " n"]


class NeighbourTable(eqx.Module):
    """Elements, unknowns and pixels nearest to the middle of each cell of a grid, or to an edge that has its middle
    there, (edges, cells, ...).

    ``low`` (2,) m is the corner of the grid, ``pitch`` m its cells' side, ``shape`` their number along y and x.
    """

    low: Float[Array, "2"]
    pitch: Float[Array, ""]
    elements: Int[Array, "edges cells e"]
    unknowns: Int[Array, "edges cells m"]
    pixels: Int[Array, "edges cells n"]
    shape: tuple[int, int] = eqx.field(static=True)

    def neighbourhood(self, loads: Float[Array, "K 6"], elements: int, pixels: int) -> Neighbourhood:
        """Neighbourhood of loads, on a mesh of so many elements and an image of so many pixels."""
        rows, columns = self.shape
        x, y = jnp.floor((loads[:, :2] - self.low) / self.pitch).astype(jnp.int32).T
        cell = jnp.clip(y, 0, rows - 1) * columns + jnp.clip(x, 0, columns - 1)
        edge = _edge_index(loads[:, 4:])
        under, unknowns, around = (table[edge, cell].ravel() for table in (self.elements, self.unknowns, self.pixels))
        count = len(loads)
        return Neighbourhood(
            under, unknowns, around, _first_occurrence(under, count, elements), _first_occurrence(around, count, pixels)
        )


def edge_half_lengths() -> Float[np.ndarray, "edges 2"]:
    """Half lengths of the edges of `NeighbourTable`, m: zero, then each length in each direction."""
    angles = np.pi * np.arange(EDGE_DIRECTIONS) / EDGE_DIRECTIONS
    along = np.stack([np.cos(angles), np.sin(angles)], 1)
    return np.concatenate([np.zeros((1, 2)), *(length * along for length in EDGE_HALF_LENGTHS)])


def _edge_index(half: Float[Array, "K 2"]) -> Int[Array, " K"]:
    """The row of `edge_half_lengths` that is nearest to each half edge, whose sign does not matter."""
    rows = jnp.asarray(edge_half_lengths(), half.dtype)
    squares = [jnp.sum((half[:, None] - sign * rows) ** 2, -1) for sign in (1, -1)]
    nearest: Array = jnp.argmin(jnp.minimum(*squares), 1)
    return nearest


def _first_occurrence(indices: Int[Array, " e"], lists: int, size: int) -> Bool[Array, " e"]:
    """Which indices no earlier list holds."""
    rows, taken, out = indices.reshape(lists, -1), jnp.zeros(size, bool), []
    for row in rows:
        out.append(~taken[row])
        taken = taken.at[row].set(True)
    return jnp.concatenate(out)


class PredictedMeasurement(NamedTuple):
    """Predicted readings and pad forces, with slopes in the parameters of loads and in some modes of the gain.

    | meaning                  | shape       | unit |
    |--------------------------|-------------|------|
    | readings, whitened       | (r,)        | 1    |
    | pads: force on each      | (pads,)     | N    |
    | reading_slopes           | (a, r)      |      |
    | pad_slopes               | (a, pads)   |      |
    """

    readings: Float[Array, " r"]
    pads: Float[Array, " pads"]
    reading_slopes: Float[Array, "a r"]
    pad_slopes: Float[Array, "a pads"]


class LoadedSheet(eqx.Module):
    """A sheet on which contacts press.

    | meaning                                                                  | shape            | unit |
    |--------------------------------------------------------------------------|------------------|------|
    | sheet: nonlinear part of the change of readings                          |                  |      |
    | neighbours: of positions                                                 |                  |      |
    | sigma: of the untouched sheet, on the coarse mesh                        | (elements,)      | S    |
    | points, weights: of the elements                                         | (elements, q, 2), (q,) | m |
    | modes: of the log gain of each element; the first is the level           | (elements, g)    | 1    |
    | pixels: their middles                                                    | (p, 2)           | m    |
    | pixel_response: readings per relative change of each, to first order     | (p, r)           | 1    |
    | pixel_modes: of the log gain of each                                     | (p, g)           | 1    |
    | pad_area: area of each pad in each pixel                                 | (p, pads)        | m^2  |
    | coat: modes of the log conductivity that is not known, on the coarse mesh | (elements, c)   | 1    |
    | untouched_slopes: of the readings of the untouched sheet in these        | (c, r)           | 1    |
    | law: factor of conductivity by pressure                                  |                  |      |
    | spreading: of loads on their way to the sheet                            |                  |      |
    """

    sheet: Reanalysis
    neighbours: NeighbourTable
    sigma: Float[Array, " elements"]
    points: Float[Array, "elements q 2"]
    weights: Float[Array, " q"]
    modes: Float[Array, "elements g"]
    pixels: Float[Array, "p 2"]
    pixel_response: Float[Array, "p r"]
    pixel_modes: Float[Array, "p g"]
    pad_area: Float[Array, "p pads"]
    coat: Float[Array, "elements c"]
    untouched_slopes: Float[Array, "c r"]
    law: ContactPiezoresistance
    spreading: Spreading

    def coat_slopes(
        self, contacts: Float[Array, "K 6"], gain: Float[Array, " g"], near: Neighbourhood
    ) -> Float[Array, "c r"]:
        """Slopes of the readings of contacts in the modes of the coat.

        A frame is a difference to the untouched sheet, so that these are the slopes of the loaded sheet less those of
        the untouched one, both on the coarse mesh.
        """
        pressures = partial(_pressures, self.spreading, contacts.astype(self.points.dtype), shapes=False)
        change, _ = self._element_changes(pressures, gain, jnp.zeros(0, jnp.int32), near)
        after = self.sheet.potential_after(near.elements, near.unknowns, change)
        loaded = self.sigma.at[near.elements].add(change)
        return (self.sheet.slopes_along(loaded * self.coat.T, after) - self.untouched_slopes).astype(contacts.dtype)

    def neighbourhood(self, contacts: Float[Array, "K 6"]) -> Neighbourhood:
        """Elements, unknowns and pixels under and around contacts."""
        return self.neighbours.neighbourhood(contacts.astype(self.points.dtype), len(self.sigma), len(self.pixels))

    def pad_loads(self, contacts: Float[Array, "K 6"], near: Neighbourhood) -> Float[Array, "K pads"]:
        """Force of each contact on each pad, N."""
        places, area = self.pixels[near.pixels], jnp.where(near.own_pixels[:, None], self.pad_area[near.pixels], 0)
        pressures = self._pressure_of_each(contacts, places)
        return (pressures @ area).astype(contacts.dtype)

    def signals(
        self, contacts: Float[Array, "K 6"], gain: Float[Array, " g"], near: Neighbourhood
    ) -> Float[Array, "K r"]:
        """Readings of each single contact, to first order."""
        pixels, own = near.pixels, near.own_pixels
        pressures = self._pressure_of_each(contacts, self.pixels[pixels])
        factor = jnp.exp(self.pixel_modes[pixels] @ gain.astype(self.pixel_modes.dtype))
        relative, _, _ = self._conductivity_change(jnp.where(own, pressures, 0), factor)
        return (relative @ self.pixel_response[pixels]).astype(contacts.dtype)

    def _pressure_of_each(self, contacts: Float[Array, "K 6"], points: Float[Array, "n 2"]) -> Float[Array, "K n"]:
        """Pressure of each contact at points, Pa."""
        of_load = partial(load_pressure, spreading=self.spreading)
        found: Array = jax.vmap(of_load, (0, None))(contacts.astype(self.points.dtype), points)
        return found

    def predict_measurement(
        self,
        contacts: Float[Array, "K 6"],
        gain: Float[Array, " g"],
        modes: Int[Array, " b"],
        near: Neighbourhood,
        shapes: bool = False,
    ) -> PredictedMeasurement:
        """Predict readings and pad forces of contacts, with slopes in their loads and in some modes of the gain.

        Args:
            shapes: after the slopes in the load of a contact come those in its shape (`pressure.line_shapes`).
        """
        pressures = partial(_pressures, self.spreading, contacts.astype(self.points.dtype), shapes=shapes)
        (force, force_slopes), (linear, linear_slopes) = self._first_order(pressures, gain, modes, near)
        change, slopes = self._element_changes(pressures, gain, modes, near)
        nonlinear = self.sheet.nonlinear_part(near.elements, near.unknowns, change)
        nonlinear_slopes = self.sheet.nonlinear_slopes(nonlinear, slopes)
        exact = contacts.dtype
        gain_slopes = jnp.zeros((len(modes), len(force)), exact)  # forces do not depend on the gain
        return PredictedMeasurement(
            (linear + nonlinear.readings).astype(exact),
            force.astype(exact),
            (linear_slopes + nonlinear_slopes).astype(exact),
            jnp.concatenate([force_slopes.astype(exact), gain_slopes]),
        )

    def _first_order(
        self, pressures: Pressures, gain: Float[Array, " g"], modes: Int[Array, " b"], near: Neighbourhood
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Forces on pads and their slopes (a, pads); readings of the image and their slopes (a, r)."""
        pixels, table = near.pixels, self.pixel_modes[near.pixels]
        pressure, slopes = (jnp.where(near.own_pixels, part, 0) for part in pressures(self.pixels[pixels]))
        area, response = self.pad_area[pixels], self.pixel_response[pixels]
        relative, along, by_gain = self._conductivity_change(pressure, jnp.exp(table @ gain.astype(table.dtype)))
        moved = jnp.concatenate([along * slopes, by_gain * table[:, modes].T])
        return (pressure @ area, slopes @ area), (relative @ response, moved @ response)

    def _element_changes(
        self, pressures: Pressures, gain: Float[Array, " g"], modes: Int[Array, " b"], near: Neighbourhood
    ) -> tuple[Float[Array, " e"], Float[Array, "a e"]]:
        """Change of conductivity of the elements, S, and its slopes."""
        elements, table = near.elements, self.modes[near.elements]
        points = self.points[elements]
        pressure, slopes = pressures(points.reshape(-1, 2))
        factor = jnp.exp(table @ gain.astype(table.dtype))
        relative, along, by_gain = self._conductivity_change(pressure.reshape(points.shape[:2]), factor[:, None])
        scale = jnp.where(near.own_elements, self.sigma[elements], 0)
        by_load = jnp.sum(along * self.weights * slopes.reshape(-1, *points.shape[:2]), 2)
        by_mode = (by_gain @ self.weights) * table[:, modes].T
        return scale * (relative @ self.weights), scale * jnp.concatenate([by_load, by_mode])

    def _conductivity_change(
        self, pressure: Float[Array, "..."], gain: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        """Relative change of conductivity under pressure times gain, and its slopes in pressure and in log gain."""
        law = jax.tree.map(lambda leaf: leaf.astype(pressure.dtype), self.law)
        effective = pressure * gain
        factor, slope = jax.jvp(law.factor, (effective,), (jnp.ones_like(effective),))
        return factor - 1, slope * gain, slope * effective


def _pressures(
    spreading: Spreading, loads: Float[Array, "K 6"], points: Float[Array, "n 2"], shapes: bool
) -> tuple[Float[Array, " n"], Float[Array, "a n"]]:
    """Pressure of all loads at points, Pa, and its slopes in the parameters of each, and in its shape if asked for."""
    values, slopes = zip(*(_pressure_and_slopes(spreading, load, points, shapes) for load in loads), strict=True)
    return jnp.sum(jnp.stack(values), 0), jnp.concatenate(slopes)


def _pressure_and_slopes(
    spreading: Spreading, load: Float[Array, "6"], points: Float[Array, "n 2"], shapes: bool
) -> tuple[Float[Array, " n"], Float[Array, "a n"]]:
    value, slopes = load_slopes(load, points, spreading)
    if not shapes:
        return value, slopes
    return value, jnp.concatenate([slopes, line_shapes(load, points, MIN_HALF_LENGTH).T])


def load_slopes(
    load: Float[Array, "6"], points: Float[Array, "n 2"], spreading: Spreading
) -> tuple[Float[Array, " n"], Float[Array, "6 n"]]:
    """`load_pressure` and its slopes in the parameters of the load, by hand, which takes a third of the time.

    The parts of a load that is spread have its place and direction, so that only their profiles are summed.
    """
    half = jnp.sqrt(load[4:] @ load[4:] + MIN_HALF_LENGTH**2)
    unit, away = (load[4:] / half)[:, None], points.T - load[:2, None]
    along = jnp.sum(unit * away, 0)
    beside, across = away - along * unit, jnp.sum(away**2, 0) - along**2
    profiles = [_profile(*part, along, across, half) for part in zip(*spreading.parts(load), strict=True)]
    value, narrow, first, last, by_width = (reduce(jnp.add, each) for each in zip(*profiles, strict=True))
    by_place = narrow * beside - (first - last) * unit
    by_half = (narrow * along + first - last) * (beside / half) + (first + last - value / half) * unit
    return value, jnp.concatenate([by_place, by_width[None], value[None], by_half])


def _profile(
    part: Float[Array, "6"],
    width_slope: Float[Array, ""],
    along: Float[Array, " n"],
    across: Float[Array, " n"],
    half: Float[Array, ""],
) -> tuple[Float[Array, " n"], ...]:
    """Pressure of a part of a load; the same over its variance; slopes by its ends; slope in the load's log width.

    Points are ``along`` the edge from its middle, m, and the root of ``across`` away from it, m^2.
    """
    inverse = jnp.exp(-2 * part[2])
    root = math.sqrt(2) * jnp.exp(part[2])
    ends = (along + half, along - half)
    peak = jnp.exp(part[3] - 0.5 * across * inverse) / (4 * math.sqrt(math.pi) * root * half)
    value = peak * (erf(ends[0] / root) - erf(ends[1] / root))
    first, last = (2 / math.sqrt(math.pi) / root * peak * jnp.exp(-((end / root) ** 2)) for end in ends)
    by_width = value * (across * inverse - 1) - (first * ends[0] - last * ends[1])
    return value, value * inverse, first, last, width_slope * by_width


def load_pressure(load: Float[Array, "6"], points: Float[Array, "... 2"], spreading: Spreading) -> Float[Array, "..."]:
    """Pressure at points, Pa, of a load (x, y, log width, log force, half length along x and y) that is spread."""
    return spreading.pressure(partial(line, min_half=MIN_HALF_LENGTH), load, points)
