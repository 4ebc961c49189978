"""What nested dissection stores: the plan of a pattern, and the factor of a matrix."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, Integer

from ..base import AbstractPlan


class LevelPlan(eqx.Module):
    """One level of m fronts with p pivots and b boundary places; see `symbolic.Level`.

    ``among`` holds the entries between pivots, ``beside`` those between pivots and boundary.
    """

    up: Integer[Array, "m b"]
    down: Integer[Array, "m c q"]
    among: Integer[Array, "m p p"]
    beside: Integer[Array, "m p b"]

    @property
    def pivots(self) -> int:
        """Number p of pivot places of each front."""
        return self.among.shape[1]


class NestedDissectionPlan(AbstractPlan):
    """The pattern, the levels from the root down, and the permutations in and out of them.

    | meaning                                                             | shape      |
    |---------------------------------------------------------------------|------------|
    | gather: unknown at each pivot place of all levels, n where padded   | (places,)  |
    | scatter: pivot place of each unknown                                | (n,)       |
    """

    rows: Integer[Array, " nnz"]
    cols: Integer[Array, " nnz"]
    diagonal: Integer[Array, " n"]
    root: Integer[Array, " r"]
    gather: Integer[Array, " places"]
    scatter: Integer[Array, " n"]
    levels: tuple[LevelPlan, ...]
    n: int = eqx.field(static=True)
    subtrees: int = eqx.field(static=True)

    @property
    def panel_shapes(self) -> list[tuple[int, int, int]]:
        """Number of fronts, of places in a front, and of pivots, for each level."""
        return [(level.down.shape[0], level.down.shape[2], level.pivots) for level in self.levels]


class Panel(NamedTuple):
    """Factor of a level for some pivots: U and W, whose b places include the later pivots."""

    upper: Float[Array, "m p p"]
    beside: Float[Array, "m p b"]


Front = tuple[Panel, ...]  # the panels of a level, in the order of elimination


class NestedDissectionFactor(eqx.Module):
    """The levels from the root down, the scaling D, and the plan."""

    levels: tuple[Front, ...]
    scale: Float[Array, " n"]
    plan: NestedDissectionPlan
