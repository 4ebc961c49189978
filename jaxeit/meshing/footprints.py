"""The constraints of electrodes on the mesh: the interface of an outline, and checks of several outlines together.

Distances between outlines do not depend on their kinds: an outline states points on its border (`corners`), the
radius of what is meshed around each of them (`reach`), and its own distance from any point.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..geometry.plane_vectors import cross
from ..geometry.shapes import Domain

RIM_MARGIN = 1.02
"""Least distance of a round outline from the rim, over its meshed radius: triangles need room between the two."""

NO_POINTS = np.zeros((0, 2))
NO_EDGES = np.zeros((0, 2), int)


class Feature(NamedTuple):
    """A point or disc that the mesh follows, (2,) m and its radius in m, and the edge length in m wanted there."""

    centre: np.ndarray
    radius: float
    size: float


class AbstractFootprint(ABC):
    """What a mesh must follow at one electrode.

    A kind of outline states where it is (`label`, `corners`, `distance`, `require_inside`) and what the mesh gets there
    (`features`, `nodes` and what else it needs of the rest, for which there are defaults).
    """

    # --- place of the outline -----------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def label(self) -> str:
        """Kind and place of the outline, for messages."""

    @property
    @abstractmethod
    def corners(self) -> np.ndarray:
        """Points (k, 2) m from which distances to other outlines are measured; (0, 2) for a part of the rim."""

    @property
    def reach(self) -> float:
        """Radius in m of the meshed area around each of the `corners`."""
        return 0.0

    @property
    def is_closed(self) -> bool:
        """Whether straight sides join the `corners` in a ring."""
        return False

    @abstractmethod
    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance of points (n, 2) m from the outline, negative inside; (n,) m, infinite for a part of the rim."""

    @abstractmethod
    def require_inside(self, domain: Domain, name: str) -> None:
        """Raise ValueError, beginning with ``name``, unless the outline lies inside the domain or on its rim."""

    def rim_positions(self, domain: Domain) -> list[float]:
        """Arc lengths in m at which the rim must have a node."""
        return []

    def covers_rim(self, domain: Domain, s: float) -> bool:
        """Whether the outline covers the rim at arc length ``s``, m."""
        return False

    def gap(self, other: "AbstractFootprint") -> float:
        """Distance in m to another outline, negative if one lies in the other; infinite for parts of the rim."""
        mine = other.distance(self.corners).min(initial=np.inf) - self.reach
        return float(min(mine, self.distance(other.corners).min(initial=np.inf) - other.reach))

    def rim_gap(self, domain: Domain) -> float:
        """Distance in m to the rim of a domain that the outline does not cross."""
        mine = domain.boundary_distance(self.corners).min(initial=np.inf) - self.reach
        return float(min(mine, self.distance(domain.boundary_point(domain.corners)).min(initial=np.inf)))

    def overlaps(self, other: "AbstractFootprint", domain: Domain) -> bool:
        """Whether two outlines overlap, or are so close that no triangles fit between them."""
        on_rim = any(self.covers_rim(domain, s) for s in other.rim_positions(domain))
        if on_rim or any(other.covers_rim(domain, s) for s in self.rim_positions(domain)):
            return True
        margin = (RIM_MARGIN - 1) * (self.reach + other.reach) + domain.tolerance
        if self.gap(other) <= margin:
            return True
        return self.is_closed and other.is_closed and sides_cross(self.corners, other.corners)

    # --- constraints on the mesh --------------------------------------------------------------------------------------

    def subdivided(
        self, domain: Domain, others: Sequence["AbstractFootprint"], edge_length: float, slope: float
    ) -> "AbstractFootprint":
        """The same outline with more edges where ``edge_length`` or a neighbour requires them; by default itself.

        Args:
            others: at least all outlines nearer than ``edge_length``.
            slope: growth of edges per distance.
        """
        return self

    @abstractmethod
    def features(self, domain: Domain, longest: float, shortest: float) -> list[Feature]:
        """The sources of the mesh's grading.

        Args:
            longest: edge length away from everything, m.
            shortest: edge length at points and at ends of arcs, where the current crowds, m.
        """

    def nodes(self, domain: Domain) -> np.ndarray:
        """Nodes (k, 2) m that the outline adds to those of the rim; by default its corners."""
        return self.corners

    def edges(self) -> np.ndarray:
        """Edges (e, 2) that the mesh must have, as pairs of row numbers of `nodes`."""
        return NO_EDGES

    def leaves_room(self, points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Whether free nodes may lie at points (n, 2), given the edge lengths (n,) m wanted there; (n,) bool."""
        return np.ones(len(points), bool)


def require_position(what: str, position: tuple[float, float]) -> None:
    """Raise ValueError unless a position is two finite numbers."""
    if np.shape(position) != (2,) or not np.all(np.isfinite(position)):
        raise ValueError(f"{what}: position is {position}; give two finite numbers in metres")


def require_centre_inside(domain: Domain, name: str, position: tuple[float, float]) -> float:
    """Distance in m of a position from the rim; ValueError, beginning with ``name``, for one outside the domain."""
    point = np.asarray([position], float)
    room = float(domain.boundary_distance(point)[0])
    if not domain.contains(point)[0]:
        raise ValueError(f"{name} is {1e3 * room:.2f} mm outside the domain; move it inside (coordinates are metres)")
    return room


def require_disc_inside(domain: Domain, name: str, position: tuple[float, float], radius: float, reach: float) -> None:
    """Raise ValueError, beginning with ``name``, unless a disc, meshed to the radius ``reach`` m, clears the rim."""
    room = require_centre_inside(domain, name, position)
    if room <= RIM_MARGIN * reach:
        raise ValueError(
            f"{name} of radius {1e3 * radius:.2f} mm is only {1e3 * room:.2f} mm from the rim; move it inward or make "
            "it smaller so that it is wholly inside the domain"
        )


def cycle(count: int) -> np.ndarray:
    """Edges (count, 2) of a closed ring of consecutive nodes."""
    around = np.arange(count)
    return np.stack([around, (around + 1) % count], axis=1)


def sides_cross(p: np.ndarray, q: np.ndarray) -> bool:
    """Whether any sides of two polygons cross; sides that only touch do not cross."""
    along_p, along_q = np.roll(p, -1, 0) - p, np.roll(q, -1, 0) - q
    offset = q - p[:, None]
    beside_p, beside_q = cross(along_p[:, None], offset), cross(offset, along_q)
    return bool(((beside_p * np.roll(beside_p, -1, 1) < 0) & (beside_q * np.roll(beside_q, -1, 0) < 0)).any())


# --- many outlines on one sheet --------------------------------------------------------------------------------------


def require_placed(domain: Domain, footprints: Sequence[AbstractFootprint]) -> None:
    """Raise ValueError, naming electrodes by their place in the sequence, unless every outline is wholly inside the
    domain (or on its rim) and apart from all others."""
    names = [f"electrode {index} ({footprint.label})" for index, footprint in enumerate(footprints)]
    for name, footprint in zip(names, footprints, strict=True):
        footprint.require_inside(domain, name)
    for i, j in _close_pairs(footprints, domain.tolerance):
        if footprints[i].overlaps(footprints[j], domain):
            raise ValueError(f"{names[i]} and {names[j]} overlap or touch; move them apart")


def neighbours(footprints: Sequence[AbstractFootprint], distance: float) -> list[list[AbstractFootprint]]:
    """For each outline, at least all others within ``distance`` m; bounding circles add some that are further away."""
    near = _may_be_within(footprints, distance)
    return [[footprints[j] for j in np.flatnonzero(row).tolist()] for row in near]


def _close_pairs(footprints: Sequence[AbstractFootprint], tolerance: float) -> list[list[int]]:
    """Pairs, lower number first, that may be too close for triangles between them."""
    reach = np.array([footprint.reach for footprint in footprints])
    margin = (RIM_MARGIN - 1) * (reach[:, None] + reach) + 2 * tolerance
    return np.argwhere(np.triu(_may_be_within(footprints, margin), 1)).tolist()


def _may_be_within(footprints: Sequence[AbstractFootprint], distance: float | np.ndarray) -> np.ndarray:
    """Whether the bounding circles of each pair are within ``distance`` m; (n, n) bool, False on the diagonal."""
    corners = [footprint.corners for footprint in footprints]
    centres = np.array([c.mean(0) if len(c) else np.zeros(2) for c in corners]).reshape(-1, 2)
    spread = (np.linalg.norm(c - m, axis=1).max(initial=0.0) for c, m in zip(corners, centres, strict=True))
    # A part of the rim has no corners and so no bounding circle: it counts as near to every outline.
    radii = [s + f.reach if len(f.corners) else np.inf for s, f in zip(spread, footprints, strict=True)]
    radius = np.array(radii)
    near = np.linalg.norm(centres[:, None] - centres, axis=2) - radius[:, None] - radius <= distance
    return np.asarray(near & ~np.eye(len(footprints), dtype=bool))
