"""Frames of the presses of a session: which polynomial gives which frame."""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from .interpolation import FrameInterpolant, enclosing_boxes, interpolant

SolvePress = Callable[[int, Float[np.ndarray, "points d"]], Float[np.ndarray, "points readings"]]


class PressFrames:
    """Frames of presses, as a function of the parameters of the sheet.

    | attribute | meaning                 |
    |-----------|-------------------------|
    | solves    | number of solved frames |
    """

    def __init__(
        self,
        solve: SolvePress,
        rest: Float[np.ndarray, " readings"],
        tolerance: float,
        extents: tuple[Float[np.ndarray, "presses phases d"], Float[np.ndarray, "presses phases d"]],
    ):
        """Divide the ranges of the parameters into boxes; nothing is solved yet.

        Args:
            solve: frames (points, readings) of a press, by its index, at points (points, d).
            rest: frame without contact.
            tolerance: error over the largest change of a press; 0: every frame is solved.
            extents: lowest and highest parameters in each phase of each press; infinite for a phase without samples.
        """
        self._solve, self._rest, self._tolerance = solve, rest, tolerance
        low, high = extents
        seen = np.isfinite(low) & np.isfinite(high)
        scale = np.where(seen, high, 0).max((0, 1)) - np.where(seen, low, 0).min((0, 1))
        parts = [enclosing_boxes(a, b, scale) for a, b in zip(low, high, strict=True)]
        # The boxes of all presses are counted together.
        self._boxes = [box for boxes, _ in parts for box in boxes]
        counts = [len(boxes) for boxes, _ in parts]
        self._press = np.repeat(np.arange(len(parts)), counts)
        self._owners = np.array([owner for _, owner in parts]) + (np.cumsum(counts) - counts)[:, None]
        self._made: dict[int, FrameInterpolant] = {}
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
                solved, part = self._tolerance == 0, points[rows]
                frames = self._solved(int(self._press[number]), part) if solved else self._polynomial(number)(part)
                out[rows] = np.where(box[rows] == number, frames, out[rows])
        return out

    def polynomials(self, press: int) -> list[FrameInterpolant]:
        """The polynomials of a press."""
        return [self._polynomial(number) for number in np.flatnonzero(self._press == press).tolist()]

    def _solved(self, press: int, points: Float[np.ndarray, "frames m d"]) -> Float[np.ndarray, "frames readings"]:
        flat, back = np.unique(points.reshape(-1, points.shape[-1]), axis=0, return_inverse=True)
        self.solves += len(flat)
        solved = self._solve(press, flat)
        return np.asarray(solved[back.reshape(points.shape[:2]), np.arange(len(self._rest))])

    def _polynomial(self, number: int) -> FrameInterpolant:
        """That of a box; those of earlier presses but the last are forgotten."""
        if number not in self._made:
            press = int(self._press[number])
            made = interpolant(self._boxes[number], partial(self._solve, press), self._rest, self._tolerance)
            self._made = {past: self._made[past] for past in self._made if self._press[past] >= press - 1}
            self._made[number] = made
            self.solves += made.solves
        return self._made[number]
