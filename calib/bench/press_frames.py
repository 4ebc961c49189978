"""Frames of the presses of a session: which polynomial gives which frame."""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from .interpolation import SOLVED_TOGETHER, FrameInterpolant, SolveEach, enclosing_boxes, interpolants

Frames = Callable[[Float[np.ndarray, "frames m d"]], Float[np.ndarray, "frames readings"]]


class PressFrames:
    """Frames of presses, as a function of the parameters of the sheet.

    | attribute | meaning                 |
    |-----------|-------------------------|
    | solves    | number of solved frames |
    """

    def __init__(
        self,
        solve: SolveEach,
        rest: Float[np.ndarray, " readings"],
        tolerance: float,
        extents: tuple[Float[np.ndarray, "presses phases d"], Float[np.ndarray, "presses phases d"]],
    ):
        """Args:
        solve: frames (points, readings) of presses, by their index (points,), at points (points, d).
        rest: frame without contact.
        tolerance: error over the largest change of a press; 0: every frame is solved.
        extents: lowest and highest parameters in each phase of each press; infinite for a phase without samples.
        """
        self._solve, self._rest, self._tolerance = solve, rest, tolerance
        low, high = extents
        seen = np.isfinite(low) & np.isfinite(high)
        scale = np.where(seen, high, 0).max((0, 1)) - np.where(seen, low, 0).min((0, 1))
        parts = [enclosing_boxes(a, b, scale) for a, b in zip(low, high, strict=True)]
        self._boxes = [boxes for boxes, _ in parts]
        self._first = np.cumsum([0, *map(len, self._boxes)])  # the boxes of all presses are counted together
        self._owners = np.array([owner for _, owner in parts]) + self._first[:-1, None]
        self._made: dict[int, list[FrameInterpolant]] = {}
        self.solves = 0

    def __call__(
        self,
        press: Int[np.ndarray, "frames m"],
        phase: Int[np.ndarray, "frames m"],
        points: Float[np.ndarray, "frames m d"],
    ) -> Float[np.ndarray, "frames readings"]:
        """Frames at parameters ``points``: one point for each reading of a frame (m readings), or one for all."""
        box = self._owners[press, phase]
        first, last = box.min(1), box.max(1)
        out = np.empty((len(points), len(self._rest)))
        for number in range(first.min(), last.max() + 1):
            rows = np.flatnonzero((first <= number) & (number <= last))
            if len(rows):
                frames = self._frames(number)(points[rows])
                out[rows] = np.where(box[rows] == number, frames, out[rows])
        return out

    def solves_in(self, press: int) -> int:
        """Number of solves that the polynomials of a press take."""
        return sum(made.solves for made in self._polynomials(press))

    def _frames(self, number: int) -> Frames:
        press = int(np.searchsorted(self._first, number, side="right")) - 1
        if self._tolerance == 0:
            return partial(self._solved, press)
        return self._polynomials(press)[number - int(self._first[press])]

    def _solved(self, press: int, points: Float[np.ndarray, "frames m d"]) -> Float[np.ndarray, "frames readings"]:
        flat, back = np.unique(points.reshape(-1, points.shape[-1]), axis=0, return_inverse=True)
        self.solves += len(flat)
        solved = self._solve(np.full(len(flat), press), flat)
        return np.asarray(solved[back.reshape(points.shape[:2]), np.arange(len(self._rest))])

    def _polynomials(self, press: int) -> list[FrameInterpolant]:
        """The polynomials of a press. A press is always made with the same others, so that all bits are the same."""
        if press not in self._made:
            group = range(press - press % SOLVED_TOGETHER, len(self._boxes))[:SOLVED_TOGETHER]
            of = np.repeat(group, [len(self._boxes[one]) for one in group])
            boxes = [box for one in group for box in self._boxes[one]]
            made = interpolants(boxes, lambda box, points: self._solve(of[box], points), self._rest, self._tolerance)
            self._made = {past: self._made[past] for past in self._made if past >= group[0] - 1}
            self._made |= {one: [each for each, its in zip(made, of, strict=True) if its == one] for one in group}
            self.solves += sum(one.solves for one in made)
        return self._made[press]
