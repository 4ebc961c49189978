"""Where the electrodes of a skin should sit, so that a scan places contacts best.

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
from .contact_information import DesignSettings, SiteContacts, sites_of
from .criteria import AbstractCriterion, PlaceError

STEP = 0.2  # of an electrode's reach, that it moves at most on one mesh
LEAST_STEP = 0.02  # likewise, below which the search ends
LEAST_GAIN = 5e-3  # part of the error, by which a mesh must lower it for the search to go on
ITERATIONS, TOLERANCE = 25, 1e-3  # of the search on one mesh
SLACK = 1e-9  # m, by which places may break a limit
MIRRORED = 1e-3  # of the sheet's size, within which a mirrored electrode is another one


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
    search = _Search.begin(skin, criterion, limits, settings, pattern, fidelity)
    first, share, made = search.error, STEP, 1
    for _ in progress(range(meshes - 1)):
        after, made = search.step(share), made + 1
        if after.value < search.value:
            gain, search = 1 - after.error / search.error, after
            if gain < LEAST_GAIN:
                break
        else:
            share *= 0.5
            if share < LEAST_STEP:
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
class _Search:
    """Electrodes at their present places, on a mesh of their own.

    | meaning                                                       | shape                        | unit |
    |---------------------------------------------------------------|------------------------------|------|
    | skin, limits, fidelity: as given, the electrodes moved        |                              |      |
    | objective, and its value                                      |                              |      |
    | home: places of the electrodes at the beginning               | (electrodes, 2)              | m    |
    | mirror: projects shifts to those that keep the symmetry       | (2 electrodes, 2 electrodes) | 1    |
    """

    skin: Skin
    limits: PlacementLimits
    fidelity: Fidelity
    objective: _Objective
    value: float
    home: np.ndarray
    mirror: np.ndarray

    @staticmethod
    def begin(
        skin: Skin,
        criterion: AbstractCriterion,
        limits: PlacementLimits,
        settings: DesignSettings,
        pattern: np.ndarray,
        fidelity: Fidelity,
    ) -> "_Search":
        """The electrodes where they sit; raises ProtocolError if they break the limits there."""
        home = np.asarray(skin.electrode_positions, float)
        if limits.margin is None:
            limits = replace(limits, margin=float(skin.domain.boundary_distance(home).min()))
        slack = np.min(_slack(skin, limits, home, home))  # before anything is computed
        if slack < -SLACK:
            raise ProtocolError(
                f"{skin.name}: the electrodes break the limits where they sit now, by {-1e3 * slack:.3g} mm; give a "
                "smaller distance or margin, or other circles to keep out of"
            )
        mirror = _mirror(skin, home) if limits.symmetric else np.eye(2 * len(home))
        model = discretise(Scene(skin), fidelity)
        contacts = SiteContacts.of(model, settings, sites_of(model, settings.columns))
        objective = _Objective(criterion, model, electrode_motion(model), contacts, jnp.asarray(pattern, jnp.int32))
        return _Search(skin, limits, fidelity, objective, _value(objective), home, mirror)

    @property
    def error(self) -> float:
        """Error of place in the measure of the criterion, m."""
        return float(self.objective.contacts.width) * self.objective.criterion.length(self.value)

    def step(self, share: float) -> "_Search":
        """The electrodes at better places, each at most this share of its reach away in x and y, on a new mesh."""
        here, objective = np.asarray(self.skin.electrode_positions, float), self.objective
        size, unit = share * float(np.min(np.asarray(objective.motion.reach))), abs(self.value)

        def shift(u: np.ndarray) -> np.ndarray:
            return np.asarray(size * (self.mirror @ u).reshape(-1, 2))

        def slack(u: np.ndarray) -> np.ndarray:
            return _slack(self.skin, self.limits, self.home, here + shift(u)) / size

        def fall(u: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = objective(jnp.asarray(shift(u), objective.model.dtype))
            by_u = size * self.mirror.T @ np.asarray(slope, float).ravel()
            return (float(value) - self.value) / unit, by_u / unit

        found = minimize(
            fall,
            np.zeros(here.size),
            jac=True,
            method="SLSQP",
            bounds=[(-1.0, 1.0)] * here.size,
            constraints={"type": "ineq", "fun": slack},
            options={"maxiter": ITERATIONS, "ftol": TOLERANCE},
        )
        skin = with_positions(self.skin, here + shift(found.x))
        model = discretise(Scene(skin), self.fidelity)
        there = replace(objective, model=model, motion=electrode_motion(model))
        return replace(self, skin=skin, objective=there, value=_value(there))


def _slack(skin: Skin, limits: PlacementLimits, home: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Lengths, m, that are zero or more where the limits hold at places (electrodes, 2) of electrodes from ``home``."""
    near = np.triu_indices(len(places), 1)
    inside = np.where(skin.domain.contains(places), 1.0, -1.0) * skin.domain.boundary_distance(places)
    parts = [np.linalg.norm(places[near[0]] - places[near[1]], axis=1) - limits.distance]
    parts += [inside - (limits.margin or 0.0)]
    parts += [np.linalg.norm(places - circle[:2], axis=1) - circle[2] for circle in limits.keep_out]
    if np.isfinite(limits.farthest):
        parts.append(limits.farthest - np.linalg.norm(places - home, axis=1))
    return np.concatenate(parts)


def _value(objective: _Objective) -> float:
    return float(objective(jnp.zeros((objective.model.electrodes, 2), objective.model.dtype))[0])


def _mirror(skin: Skin, places: np.ndarray) -> np.ndarray:
    """The projection of shifts, (2 electrodes, 2 electrodes), to those that keep the mirror symmetries of the places.

    The mirrors are those across the middle of the sheet along x and y that map electrodes to electrodes.
    """
    low, high = np.asarray(skin.domain.bounds)
    middle, size = 0.5 * (low + high), float(np.max(high - low))
    kept = np.eye(2 * len(places))
    for axis in range(2):
        sign = np.where(np.arange(2) == axis, -1.0, 1.0)
        away = np.linalg.norm((middle + sign * (places - middle))[:, None] - places, axis=2)
        partner = away.argmin(1)
        if (away.min(1) < MIRRORED * size).all() and len(set(partner.tolist())) == len(places):
            image = np.zeros_like(kept)
            for k, other in enumerate(partner):
                image[2 * other : 2 * other + 2, 2 * k : 2 * k + 2] = np.diag(sign)
            kept = 0.5 * (kept + image @ kept)
    return np.asarray(kept)
