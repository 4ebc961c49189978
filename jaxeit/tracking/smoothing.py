"""Contacts of a recording, each frame smoothed by the frames after it as well as by those before.

A smoother of Rauch, Tung and Striebel (1965, AIAA J. 3) for the state of one contact, from birth to death: with the
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
from .belief.contact_filter import predict
from .belief.state import CONTACT_SIZE, Belief, contact_slice
from .tracker import Tracker
from .tracks import Track, Tracking, track_of

# Number of later frames that smooth a frame; a contact's velocity forgets them sooner.
DEFAULT_LAG = 256
# Covariance over that of the prediction above which a contact has jumped; less is rounding.
JUMP_RATIO = 1 + 1e-6


class Transition(NamedTuple):
    """From the state of a contact in one frame to that in the next: matrix (8, 8) and covariance of the walk."""

    matrix: Float[np.ndarray, "8 8"]
    walk: Float[np.ndarray, "8 8"]


class State(NamedTuple):
    """State of one contact in a frame: mean (8,) and covariance (8, 8), in the order of `Belief`."""

    mean: Float[np.ndarray, "8"]
    covariance: Float[np.ndarray, "8 8"]


def transition_after(tracker: Tracker, seconds: float) -> Transition:
    """The transition by which the filter predicts a contact so many seconds later."""
    dtype = tracker.filter.places.dtype
    unit, none = jnp.eye(CONTACT_SIZE, dtype=dtype), partial(jnp.zeros, dtype=dtype)
    numbers = Belief(unit, none(1), none((CONTACT_SIZE**2 + 1,) * 2), level=none(2).at[1].set(1))
    found = predict(tracker.filter, numbers, jnp.asarray(seconds))
    return Transition(np.asarray(found.contacts).T, np.asarray(found.covariance)[:CONTACT_SIZE, :CONTACT_SIZE])


def smooth(states: Sequence[State], steps: Sequence[Transition]) -> list[State]:
    """Smooth the states of a contact in consecutive frames.

    Args:
        states: of the filter.
        steps: from each frame to the next one, one fewer than states.
    """
    found = list(states[-1:])
    for state, step, next_filtered in zip(states[-2::-1], steps[::-1], states[:0:-1], strict=True):
        found.append(_smooth_step(state, step, next_filtered, found[-1]))
    return found[::-1]


def _smooth_step(state: State, step: Transition, next_filtered: State, next_smoothed: State) -> State:
    """Smooth a state, given the next one as filtered and as smoothed."""
    matrix, walk = step
    predicted = matrix @ state.covariance @ matrix.T + walk
    # Units differ: metres beside logarithms.
    scale = np.sqrt(np.diag(predicted))
    root = np.linalg.cholesky(predicted / np.outer(scale, scale))
    whitened = np.linalg.solve(root, np.linalg.solve(root, next_filtered.covariance / np.outer(scale, scale)).T)
    # A frame only takes uncertainty away. Where there is more than was predicted, the tracker has let the contact jump,
    # and later frames tell nothing of where it was before.
    if np.linalg.eigvalsh(0.5 * (whitened + whitened.T))[-1] > JUMP_RATIO:
        return state
    gain = np.linalg.solve(predicted / np.outer(scale, scale), (matrix @ state.covariance) / scale[:, None]).T / scale
    reduction = np.eye(CONTACT_SIZE) - gain @ matrix
    # Joseph's form: a sum of positive parts, where P - G (P_predicted - P_smoothed) G^T would cancel.
    covariance = reduction @ state.covariance @ reduction.T + gain @ (walk + next_smoothed.covariance) @ gain.T
    return State(state.mean + gain @ (next_smoothed.mean - matrix @ state.mean), 0.5 * (covariance + covariance.T))


class TimedTracks(NamedTuple):
    """The contacts ``tracks`` at a ``time`` (ns)."""

    time: int
    tracks: tuple[Track, ...]


@dataclass(frozen=True, eq=False)
class _Frame:
    """Filtered contacts after a frame: time (ns), states and edges by number, and seconds since the last frame."""

    time: int
    states: dict[int, State]
    edges: dict[int, bool]
    considered: ConsiderErrors
    seconds: float

    def timed_tracks(self, states: dict[int, State]) -> TimedTracks:
        whole = {n: self.considered.add_to(n, state.covariance) for n, state in states.items()}
        tracks = (track_of(n, states[n].mean, whole[n], edge) for n, edge in self.edges.items())
        return TimedTracks(self.time, tuple(tracks))


class Smoother:
    """Smooths tracks while they come, in bounded memory: each frame is smoothed by at least ``lag`` frames after it.

    The numbers of contacts, and which of them are edges, are those of the filter.

    Args:
        lag: number of frames, default `DEFAULT_LAG`.

    Example:
        smoother, now = tracking.Smoother(tracker), tracker.start()
        for k, frame in enumerate(frames):
            now = tracker.step(now, frame, seconds=0.01)
            for time, tracks in smoother.add(10_000_000 * k, now, 0.01):  # ns
                print(time, tracks)  # of a frame some time ago
        for time, tracks in smoother.end():
            print(time, tracks)  # of the last frames
    """

    def __init__(self, tracker: Tracker, lag: int = DEFAULT_LAG):
        self._lag = lag
        self._frames: deque[_Frame] = deque()
        self._transition = lru_cache(maxsize=4 * lag)(partial(transition_after, tracker))

    def add(self, time: int, now: Tracking, seconds: float) -> Iterator[TimedTracks]:
        """Take what is known after a frame at a time (ns), so many seconds after the last one; and give back what is
        settled."""
        contacts, covariance = np.asarray(now.belief.contacts), np.asarray(now.belief.covariance)
        states = {
            number: State(contacts[k], covariance[contact_slice(k), contact_slice(k)])
            for k, number in enumerate(now.numbers)
        }
        edges = dict(zip(now.numbers, now.edges, strict=True))
        self._frames.append(_Frame(time, states, edges, now.considered, seconds))
        if len(self._frames) > 2 * self._lag:
            yield from self._smooth_oldest(self._lag)

    def end(self) -> Iterator[TimedTracks]:
        """Give back the frames that are left."""
        yield from self._smooth_oldest(len(self._frames))

    def _smooth_oldest(self, count: int) -> Iterator[TimedTracks]:
        """Smooth all frames at hand, and give back the oldest of them."""
        found: list[dict[int, State]] = [{} for _ in self._frames]
        for number in dict.fromkeys(number for frame in self._frames for number in frame.states):
            rows = [at for at, frame in enumerate(self._frames) if number in frame.states]
            frames = [self._frames[at] for at in rows]
            steps = [self._transition(frame.seconds) for frame in frames[1:]]
            states = smooth([frame.states[number] for frame in frames], steps)
            for at, state in zip(rows, states, strict=True):
                found[at][number] = state
        for smoothed in found[:count]:
            yield self._frames.popleft().timed_tracks(smoothed)
