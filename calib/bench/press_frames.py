"""Frames of the presses of a session: which polynomial gives which frame, and threads that make the polynomials."""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from .interpolation import FrameInterpolant, Solve, enclosing_boxes

PRESSES_AHEAD = 4  # presses that the threads work on while the frames of another are computed

Frames = Callable[[Float[np.ndarray, "frames m d"]], Float[np.ndarray, "frames readings"]]


class PressFrames:
    """Frames of presses, as a function of the parameters of the sheet.

    | attribute | meaning                 |
    |-----------|-------------------------|
    | solves    | number of solved frames |
    """

    def __init__(
        self,
        solve: Callable[[int, np.ndarray], np.ndarray],
        rest: Float[np.ndarray, " readings"],
        tolerance: float,
        extents: tuple[Float[np.ndarray, "presses phases d"], Float[np.ndarray, "presses phases d"]],
    ):
        """Args:
        solve: frames (points, readings) of a press, by its index, at points (points, d); threads use it.
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
        self._threads = ThreadPoolExecutor(os.cpu_count())
        self._coming: dict[int, list[Future[FrameInterpolant]]] = {}
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
            return partial(self._solved, partial(self._solve, press))
        return self._polynomials(press)[number - int(self._first[press])]

    def _solved(self, solve: Solve, points: Float[np.ndarray, "frames m d"]) -> Float[np.ndarray, "frames readings"]:
        flat, back = np.unique(points.reshape(-1, points.shape[-1]), axis=0, return_inverse=True)
        self.solves += len(flat)
        parts = np.array_split(flat, min(len(flat), os.cpu_count() or 1))
        solved = np.concatenate(list(self._threads.map(solve, parts)))
        return np.asarray(solved[back.reshape(points.shape[:2]), np.arange(solved.shape[1])])

    def _polynomials(self, press: int) -> list[FrameInterpolant]:
        """The polynomials of a press; the threads go on with those of the presses that follow."""
        for coming in range(press, min(press + PRESSES_AHEAD, len(self._boxes) - 1) + 1):
            if coming not in self._made and coming not in self._coming:
                arguments = partial(self._solve, coming), self._rest, self._tolerance
                self._coming[coming] = [
                    self._threads.submit(FrameInterpolant, box, *arguments) for box in self._boxes[coming]
                ]
        if press in self._coming:
            self._made = {past: made for past, made in self._made.items() if past >= press - 1}
            self._made[press] = self._finished(self._coming.pop(press))
            self.solves += sum(made.solves for made in self._made[press])
        return self._made[press]

    def _finished(self, coming: list[Future[FrameInterpolant]]) -> list[FrameInterpolant]:
        try:
            return [made.result() for made in coming]
        except BaseException:  # such as Ctrl-C: the interpreter would wait for all that is queued
            self._threads.shutdown(wait=False, cancel_futures=True)
            raise
