"""Optimal placement of the electrodes of a skin for the localisation of contacts by its scan.

The error of place that a scan promises (`contact_information`) is a smooth function of the electrodes' positions: the
mesh follows them (`model.motion`), the contacts stay where they are. Sequential quadratic programming (Kraft 1988,
`scipy.optimize`) lowers it within distances that the hardware asks for. A mesh follows its electrodes a few
millimetres; then a new mesh is made, and a step that does not hold on the new mesh is tried again with half of its
length.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer
from scipy.optimize import minimize

from .._compile import verb
from ..model.discretisation import Model, discretise
from ..model.fidelity import Fidelity
from ..model.motion import Motion, electrode_motion, moved
from ..model.scene import Scene
from ..skin.description import Skin
from ..skin.protocol import ProtocolError
from ..skin.rewriting import with_positions
from .contact_information import DesignSettings, SiteContacts, sheet_sites
from .criteria import AbstractCriterion, PlaceError

MAX_STEP = 0.2  # largest step of an electrode on one mesh, over its reach
MIN_STEP = 0.02  # likewise, below which the search ends
MIN_RELATIVE_GAIN = 5e-3  # least fall of the error by a mesh, over the error; with less the search ends
MAX_ITERATIONS, FALL_TOLERANCE = 25, 1e-3  # of the search on one mesh
LIMIT_ATOL = 1e-9  # m, by which places may violate a limit
MIRROR_TOLERANCE = 1e-3  # largest distance of a mirrored electrode from its partner, over the sheet's size


@dataclass(frozen=True)
class PlacementLimits:
    """Limits of the hardware on the places of electrodes.

    | meaning                                                                           | default | unit |
    |-----------------------------------------------------------------------------------|---------|------|
    | distance: of the middles of two electrodes, at least                              | 0.015   | m    |
    | margin: from a middle to the rim, at least; None: as the electrode nearest to it  | None    | m    |
    | keep_out: circles (x, y, radius) in which no middle may lie                       | ()      | m    |
    | farthest: from where an electrode sits now                                        | inf     | m    |
    | symmetric: keep the mirror symmetries that the electrodes have                    | True    |      |

    Raises:
        ProtocolError: for a value out of range.
    """

    distance: float = 0.015
    margin: float | None = None
    keep_out: tuple[tuple[float, float, float], ...] = ()
    farthest: float = np.inf
    symmetric: bool = True

    def __post_init__(self) -> None:
        for name in ("distance", "farthest", *(("margin",) if self.margin is not None else ())):
            if not getattr(self, name) > 0:
                raise ProtocolError(f"{name} is {getattr(self, name)}; give a length above 0")
        for circle in self.keep_out:
            if len(circle) != 3 or not np.isfinite(circle).all() or not circle[2] > 0:
                raise ProtocolError(f"keep_out has {circle}; give x, y and a radius above 0, in m")


class Placement(NamedTuple):
    """Where the electrodes should sit.

    | meaning                                                                  | shape | unit |
    |--------------------------------------------------------------------------|-------|------|
    | skin: with its electrodes there                                          |       |      |
    | before, after: error of place in the measure of the criterion            | ()    | m    |
    | meshes: that were made on the way                                        | ()    |      |
    """

    skin: Skin
    before: float
    after: float
    meshes: int


def move_electrodes(
    skin: Skin,
    criterion: AbstractCriterion | None = None,
    limits: PlacementLimits | None = None,
    settings: DesignSettings | None = None,
    *,
    pattern: Integer[np.ndarray, "readings 4"] | None = None,
    fidelity: Fidelity | None = None,
    meshes: int = 12,
    progress: Callable[[Iterable[Any]], Iterable[Any]] = iter,
) -> Placement:
    """Move the electrodes of a skin to where its scan places contacts best, on a flat sheet or on a surface.

    Electrodes on the rim move along it. The result is a local optimum, the one downhill from the given places.

    Args:
        criterion: default `PlaceError`; ``PlaceError(8.0)`` looks at the worst places.
        limits: default `PlacementLimits()`.
        settings: contacts and noise; default `DesignSettings()`.
        pattern: readings of a frame; default: the skin's own.
        fidelity: default `Fidelity.draft()`.
        meshes: made at most.
        progress: wraps the meshes, as a progress bar does.

    Raises:
        ProtocolError: if the electrodes break the limits where they sit now.
        MotionError: if the electrodes cannot be moved.
        TomlError: if the skin's text gives no positions of electrodes.

    Example:
        limits = je.scan.PlacementLimits(distance=0.02, farthest=0.01)  # m
        coarse = je.scan.DesignSettings(columns=4)
        placed = je.scan.move_electrodes(skin, limits=limits, settings=coarse, meshes=2)
        print(f"{1e3 * placed.before:.2f} mm before, {1e3 * placed.after:.2f} mm after")
        print(placed.skin.toml.count("\\n"), "lines, for a file of its own")
    """
    criterion, limits = criterion or PlaceError(), limits or PlacementLimits()
    settings, fidelity = settings or DesignSettings(), fidelity or Fidelity.draft()
    pattern = np.asarray(skin.protocol.rows("move_electrodes") if pattern is None else pattern)
    search = _PlacementSearch.start(skin, criterion, limits, settings, pattern, fidelity)
    first, share, made = search.error, MAX_STEP, 1
    for _ in progress(range(meshes - 1)):
        after, made = search.step(share), made + 1
        if after.value < search.value:
            gain, search = 1 - after.error / search.error, after
            if gain < MIN_RELATIVE_GAIN:
                break
        else:
            share *= 0.5
            if share < MIN_STEP:
                break
    return Placement(search.skin, first, search.error, made)


class _Objective(eqx.Module):
    """The mean of the criterion's h over contacts that stay where they are, on one mesh."""

    criterion: AbstractCriterion
    model: Model
    motion: Motion
    contacts: SiteContacts
    pattern: Int[Array, "readings 4"]

    @verb
    def __call__(self, shift: Float[Array, "electrodes 2"]) -> tuple[Float[Array, ""], Float[Array, "electrodes 2"]]:
        """The mean of h for electrodes that are shifted, and its derivative."""
        return jax.value_and_grad(self._mean)(shift)

    def _mean(self, shift: Float[Array, "electrodes 2"]) -> Float[Array, ""]:
        chart = self.model.chart + jnp.einsum("nij,nj->ni", self.motion.chart_step, shift[self.motion.electrode])
        sensitivity = self.contacts.sensitivity(moved(self.model, self.motion, shift), chart)
        return self.criterion.mean(sensitivity.covariance(sensitivity.rows(self.pattern)))


@dataclass(frozen=True, eq=False)
class _PlacementSearch:
    """Electrodes at their present places, on a mesh of their own.

    | meaning                                                       | shape                        | unit |
    |---------------------------------------------------------------|------------------------------|------|
    | skin, limits, fidelity: as given, the electrodes moved        |                              |      |
    | objective, and its value                                      |                              |      |
    | initial: places of the electrodes before the search           | (electrodes, 2)              | m    |
    | projection: of shifts to those that keep the symmetry         | (2 electrodes, 2 electrodes) | 1    |
    """

    skin: Skin
    limits: PlacementLimits
    fidelity: Fidelity
    objective: _Objective
    value: float
    initial: np.ndarray
    projection: np.ndarray

    @staticmethod
    def start(
        skin: Skin,
        criterion: AbstractCriterion,
        limits: PlacementLimits,
        settings: DesignSettings,
        pattern: np.ndarray,
        fidelity: Fidelity,
    ) -> "_PlacementSearch":
        """The search at the present places; raises ProtocolError if they break the limits."""
        initial = np.asarray(skin.electrode_positions, float)
        if limits.margin is None:
            limits = replace(limits, margin=float(skin.domain.boundary_distance(initial).min()))
        slack = np.min(_constraints(skin, limits, initial, initial))  # before anything is computed
        if slack < -LIMIT_ATOL:
            raise ProtocolError(
                f"{skin.name}: the electrodes break the limits where they sit now, by {-1e3 * slack:.3g} mm; give a "
                "smaller distance or margin, or other circles to keep out of"
            )
        projection = _symmetry_projection(skin, initial) if limits.symmetric else np.eye(2 * len(initial))
        model = discretise(Scene(skin), fidelity)
        contacts = SiteContacts.of(model, settings, sheet_sites(model, settings.columns))
        objective = _Objective(criterion, model, electrode_motion(model), contacts, jnp.asarray(pattern, jnp.int32))
        return _PlacementSearch(skin, limits, fidelity, objective, _value(objective), initial, projection)

    @property
    def error(self) -> float:
        """Error of place in the measure of the criterion, m."""
        return float(self.objective.contacts.width) * self.objective.criterion.length(self.value)

    def step(self, share: float) -> "_PlacementSearch":
        """The electrodes at better places, each at most this share of its reach away in x and y, on a new mesh."""
        positions, objective = np.asarray(self.skin.electrode_positions, float), self.objective
        size, unit = share * float(np.min(np.asarray(objective.motion.reach))), abs(self.value)

        def shift(u: np.ndarray) -> np.ndarray:
            return np.asarray(size * (self.projection @ u).reshape(-1, 2))

        def constraints(u: np.ndarray) -> np.ndarray:
            return _constraints(self.skin, self.limits, self.initial, positions + shift(u)) / size

        def relative_change(u: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = objective(jnp.asarray(shift(u), objective.model.dtype))
            by_u = size * self.projection.T @ np.asarray(slope, float).ravel()
            return (float(value) - self.value) / unit, by_u / unit

        solution = minimize(
            relative_change,
            np.zeros(positions.size),
            jac=True,
            method="SLSQP",
            bounds=[(-1.0, 1.0)] * positions.size,
            constraints={"type": "ineq", "fun": constraints},
            options={"maxiter": MAX_ITERATIONS, "ftol": FALL_TOLERANCE},
        )
        skin = with_positions(self.skin, positions + shift(solution.x))
        model = discretise(Scene(skin), self.fidelity)
        next_objective = replace(objective, model=model, motion=electrode_motion(model))
        return replace(self, skin=skin, objective=next_objective, value=_value(next_objective))


def _constraints(skin: Skin, limits: PlacementLimits, initial: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Slacks of the limits, m: zero or more where they hold; ``places``: of the electrodes, moved from ``initial``."""
    i, j = np.triu_indices(len(places), 1)
    inside = np.where(skin.domain.contains(places), 1.0, -1.0) * skin.domain.boundary_distance(places)
    parts = [np.linalg.norm(places[i] - places[j], axis=1) - limits.distance]
    parts += [inside - (limits.margin or 0.0)]
    parts += [np.linalg.norm(places - circle[:2], axis=1) - circle[2] for circle in limits.keep_out]
    if np.isfinite(limits.farthest):
        parts.append(limits.farthest - np.linalg.norm(places - initial, axis=1))
    return np.concatenate(parts)


def _value(objective: _Objective) -> float:
    return float(objective(jnp.zeros((objective.model.electrodes, 2), objective.model.dtype))[0])


def _symmetry_projection(skin: Skin, places: np.ndarray) -> np.ndarray:
    """The projection of shifts, (2 electrodes, 2 electrodes), to those that keep the mirror symmetries of the places.

    The mirrors are those across the middle of the sheet along x and y that map electrodes to electrodes.
    """
    low, high = np.asarray(skin.domain.bounds)
    middle, size = 0.5 * (low + high), float(np.max(high - low))
    result = np.eye(2 * len(places))
    for axis in range(2):
        sign = np.where(np.arange(2) == axis, -1.0, 1.0)
        distance = np.linalg.norm((middle + sign * (places - middle))[:, None] - places, axis=2)
        partner = distance.argmin(1)
        if (distance.min(1) < MIRROR_TOLERANCE * size).all() and len(set(partner.tolist())) == len(places):
            image = np.zeros_like(result)
            for k, other in enumerate(partner):
                image[2 * other : 2 * other + 2, 2 * k : 2 * k + 2] = np.diag(sign)
            result = 0.5 * (result + image @ result)
    return np.asarray(result)
