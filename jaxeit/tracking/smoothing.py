"""Contacts of a recording, each frame told by the frames after it as well as by those before.

A smoother of Rauch, Tung and Striebel (1965, AIAA J. 3) for the numbers of one contact, from birth to death: with the
filter's mean m and covariance P of a frame, and the transition F, Q to the next one,

    p = F m,   S = F P F^T + Q,   G = P F^T S^-1,
    m' = m + G (m'_next - p),   P' = (1 - G F) P (1 - G F)^T + G Q G^T + G P'_next G^T,

where the covariance is in Joseph's form, which stays definite. What is uncertain because the gain of the contact layer
is unknown is in P, and is the same in all frames; the filter knows this, so later frames do not make P' too small.

Later frames tell nothing across a jump, or where a contact has turned out to be an edge: there the covariance of the
filter is larger than the prediction's, and the smoother begins again.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .belief.consider import ConsiderErrors
from .belief.filter import CONTACT_SIZE, Belief, numbers_of, predicted
from .tracker import Tracker
from .tracks import Track, Tracking, track_of

# Frames after a frame that tell of it; a contact's velocity forgets them sooner.
LAG = 256
# A covariance above the prediction's by this factor is no rounding.
JUMPED = 1 + 1e-6


class Transition(NamedTuple):
    """From the numbers of a contact in one frame to those in the next: matrix (8, 8) and covariance of the walk."""

    matrix: Float[np.ndarray, "8 8"]
    walk: Float[np.ndarray, "8 8"]


class State(NamedTuple):
    """Numbers of one contact in a frame: mean (8,) and covariance (8, 8), in the order of `Belief`."""

    mean: Float[np.ndarray, "8"]
    covariance: Float[np.ndarray, "8 8"]


def transition(tracker: Tracker, seconds: float) -> Transition:
    """How the filter predicts a contact so many seconds later."""
    dtype = tracker.filter.places.dtype
    unit, none = jnp.eye(CONTACT_SIZE, dtype=dtype), partial(jnp.zeros, dtype=dtype)
    numbers = Belief(unit, none(1), none((CONTACT_SIZE**2 + 1,) * 2), level=none(2).at[1].set(1))
    found = predicted(tracker.filter, numbers, jnp.asarray(seconds))
    return Transition(np.asarray(found.contacts).T, np.asarray(found.covariance)[:CONTACT_SIZE, :CONTACT_SIZE])


def smoothed(states: Sequence[State], steps: Sequence[Transition]) -> list[State]:
    """The states of a contact in consecutive frames, given all of them.

    Args:
        states: of the filter.
        steps: from each frame to the next one, one fewer than states.
    """
    found = list(states[-1:])
    for state, step, after in zip(states[-2::-1], steps[::-1], states[:0:-1], strict=True):
        found.append(_one_back(state, step, after, found[-1]))
    return found[::-1]


def _one_back(state: State, step: Transition, after: State, told: State) -> State:
    """A state, given the next one by the filter and by all frames."""
    matrix, walk = step
    ahead = matrix @ state.covariance @ matrix.T + walk
    # Units differ: metres beside logarithms.
    scale = np.sqrt(np.diag(ahead))
    root = np.linalg.cholesky(ahead / np.outer(scale, scale))
    white = np.linalg.solve(root, np.linalg.solve(root, after.covariance / np.outer(scale, scale)).T)
    if np.linalg.eigvalsh(0.5 * (white + white.T))[-1] > JUMPED:
        return state
    gain = np.linalg.solve(ahead / np.outer(scale, scale), (matrix @ state.covariance) / scale[:, None]).T / scale
    kept = np.eye(CONTACT_SIZE) - gain @ matrix
    covariance = kept @ state.covariance @ kept.T + gain @ (walk + told.covariance) @ gain.T
    return State(state.mean + gain @ (told.mean - matrix @ state.mean), 0.5 * (covariance + covariance.T))


class TimedTracks(NamedTuple):
    """The contacts ``tracks`` at a ``time`` (ns)."""

    time: int
    tracks: tuple[Track, ...]


@dataclass(frozen=True, eq=False)
class _Frame:
    """What the filter knew after a frame: time (ns), states and edges by number, and seconds since the last frame."""

    time: int
    states: dict[int, State]
    edges: dict[int, bool]
    considered: ConsiderErrors
    seconds: float

    def timed(self, states: dict[int, State]) -> TimedTracks:
        whole = {n: self.considered.added(n, state.covariance) for n, state in states.items()}
        tracks = (track_of(n, states[n].mean, whole[n], edge) for n, edge in self.edges.items())
        return TimedTracks(self.time, tuple(tracks))


class Smoother:
    """Smooths tracks while they come, in bounded memory: each frame is smoothed by at least ``lag`` frames after it.

    The numbers of contacts, and which of them are edges, are those of the filter.

    Args:
        lag: number of frames, default `LAG`.

    Example:
        smoother, now = tracking.Smoother(tracker), tracker.start()
        for k, frame in enumerate(frames):
            now = tracker.step(now, frame, seconds=0.01)
            for time, tracks in smoother.add(10_000_000 * k, now, 0.01):  # ns
                print(time, tracks)  # of a frame some time ago
        for time, tracks in smoother.end():
            print(time, tracks)  # of the last frames
    """

    def __init__(self, tracker: Tracker, lag: int = LAG):
        self._lag = lag
        self._frames: deque[_Frame] = deque()
        self._transition = lru_cache(maxsize=4 * lag)(partial(transition, tracker))

    def add(self, time: int, now: Tracking, seconds: float) -> Iterator[TimedTracks]:
        """Take what is known after a frame at a time (ns), so many seconds after the last one; and give back what is
        settled."""
        contacts, covariance = np.asarray(now.belief.contacts), np.asarray(now.belief.covariance)
        states = {
            number: State(contacts[k], covariance[numbers_of(k), numbers_of(k)]) for k, number in enumerate(now.numbers)
        }
        edges = dict(zip(now.numbers, now.edges, strict=True))
        self._frames.append(_Frame(time, states, edges, now.considered, seconds))
        if len(self._frames) > 2 * self._lag:
            yield from self._settled(self._lag)

    def end(self) -> Iterator[TimedTracks]:
        """Give back the frames that are left."""
        yield from self._settled(len(self._frames))

    def _settled(self, count: int) -> Iterator[TimedTracks]:
        """Smooth all frames at hand, and give back the first of them."""
        found: list[dict[int, State]] = [{} for _ in self._frames]
        for number in dict.fromkeys(number for frame in self._frames for number in frame.states):
            lived = [at for at, frame in enumerate(self._frames) if number in frame.states]
            own = [self._frames[at] for at in lived]
            steps = [self._transition(frame.seconds) for frame in own[1:]]
            states = smoothed([frame.states[number] for frame in own], steps)
            for at, state in zip(lived, states, strict=True):
                found[at][number] = state
        for settled in found[:count]:
            yield self._frames.popleft().timed(settled)
