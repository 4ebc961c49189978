"""Contacts followed from frame to frame: they are born, move, press, lift and die, and keep their numbers.

Where a frame is not what the contacts so far lead to expect, the belief before it is updated in several ways: as it is;
with contacts that have jumped; without one of them; with one, or two, that are an edge; with one more. The way under
which the frame was most probable is taken, with the rates of such events as prior (evidence by Laplace's approximation,
MacKay 1992, Neural Comput. 4). An ordinary frame is one update.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import require_known
from ..imaging.background import sheet_of
from ..imaging.noise import InverseError
from ..model.discretisation import Model
from ..skin.description import Skin
from .events import inserted, joined, jumped, lengthened, without
from .filter import EDGE, SHAPE, SIZE, VELOCITY, Belief, ContactFilter, Pads, Update, predicted, unexplained, updated
from .preparation import prepare_filter
from .settings import TrackerSettings

# A frame is expected if what is left of it is below this many of its standard deviations above its mean, and no number
# of the belief changes by much more than it may.
UNEXPECTED, SURPRISING = 4.0, 25.0
# A frame that no event explains is asked about again after so many frames, or where it has become so much worse.
PATIENCE, WORSE = 10, 1.3
# Events that one frame may show.
EVENTS = 4
# A contact dies after as many frames in which its signal is below so many standard deviations of the noise.
FAINT, FAINT_FRAMES = 4.0, 2
# Signal of a contact that begins beside others, at least: in standard deviations of the noise, and over that of all.
MIN_LOUDNESS, RIPPLE = 12.0, 0.05
# Directions of an edge that are tried.
DIRECTIONS = np.pi * np.arange(4) / 4
# Prior deviations of the place and the velocity of a contact that begins, m and m/s.
PLACE, SPEED = 0.012, 0.05
# Half an edge that is none: what keeps its covariance definite, m.
ROUND = 1e-4


class Track(NamedTuple):
    """A contact as it is now.

    | meaning                                                             | shape  | unit  |
    |---------------------------------------------------------------------|--------|-------|
    | number: of the contact, which it keeps while it lives               |        |       |
    | position in the sheet's flat coordinates; of an edge, its middle    | (2,)   | m     |
    | covariance of the position                                          | (2, 2) | m^2   |
    | width: standard deviation of the load, across an edge               |        | m     |
    | force, and the standard deviation of its logarithm                  |        | N, 1  |
    | half: from the middle of an edge to its end; zero for other contacts | (2,)  | m     |
    | velocity                                                            | (2,)   | m/s   |
    """

    number: int
    position: np.ndarray
    covariance: np.ndarray
    width: float
    force: float
    log_force_error: float
    half: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True, eq=False)
class Tracking:
    """What a `Tracker` knows after a frame.

    | meaning                                                               |
    |-----------------------------------------------------------------------|
    | belief: of contacts and gain                                          |
    | numbers: of the contacts                                              |
    | edges: which of them are edges                                        |
    | faint: for how many frames each has hardly been seen                  |
    | begun: number of contacts so far                                      |
    | misfit: chi-square of the last frame that was looked into, and frames since then |
    """

    belief: Belief
    numbers: tuple[int, ...] = ()
    edges: tuple[bool, ...] = ()
    faint: tuple[int, ...] = ()
    begun: int = 0
    misfit: float = 0.0
    since: int = 0

    @property
    def tracks(self) -> tuple[Track, ...]:
        """The contacts, in the order in which they began."""
        contacts, covariance = np.asarray(self.belief.contacts), np.asarray(self.belief.covariance)
        return tuple(
            _track(number, contacts[k], covariance[SIZE * k : SIZE * (k + 1), SIZE * k : SIZE * (k + 1)], edge)
            for k, (number, edge) in enumerate(zip(self.numbers, self.edges, strict=True))
        )


def _track(number: int, row: np.ndarray, covariance: np.ndarray, edge: bool) -> Track:
    return Track(
        number=number,
        position=row[:2],
        covariance=covariance[:2, :2],
        width=float(np.exp(row[2])),
        force=float(np.exp(row[3])),
        log_force_error=float(np.sqrt(covariance[3, 3])),
        half=row[EDGE] if edge else np.zeros(2),
        velocity=row[VELOCITY],
    )


class _Hypothesis(NamedTuple):
    """A belief before a frame, with the contacts that it holds, and the log of its prior probability."""

    belief: Belief
    numbers: tuple[int, ...]
    edges: tuple[bool, ...]
    prior: float


class Tracker:
    """Follows contacts through the frames of a skin; made by `prepare_tracker`. ::

    now = tracker.start()
    for frame, forces in ...:
        now = tracker.step(now, frame, seconds=0.01, pad_forces=forces, pad_errors=errors)
        print(now.tracks)
    """

    def __init__(self, tracker: ContactFilter, settings: TrackerSettings, area: float):
        self.filter, self._settings, self._area = tracker, settings, area
        self._usual = np.log([settings.loads.width, settings.loads.force])
        self._spread = np.array([settings.loads.width_spread, settings.loads.force_spread])

    @property
    def settings(self) -> TrackerSettings:
        """What is known of contacts before they are followed."""
        return self._settings

    def start(self) -> Tracking:
        """No contact, and the gain as it is known before the first frame."""
        size = len(self.filter.places)
        dtype = self.filter.places.dtype
        return Tracking(Belief(jnp.zeros((0, SIZE), dtype), jnp.zeros(size, dtype), jnp.eye(size, dtype=dtype)))

    def step(
        self,
        now: Tracking,
        dv: Float[ArrayLike, " readings"],
        seconds: float,
        pad_forces: Float[ArrayLike, " pads"] | None = None,
        pad_errors: Float[ArrayLike, " pads"] | None = None,
    ) -> Tracking:
        """The contacts after a difference frame (readings,) V; readings that are not finite are left out.

        Args:
            seconds: since the last frame.
            pad_forces: on the pads, (pads,) N; default, or NaN: not known.
            pad_errors: their standard errors, (pads,) N.

        Raises:
            InverseError: if an array has another shape, or `seconds` is not above zero.
        """
        frame, pads = self._frame(dv), self._pads(pad_forces, pad_errors)
        if not 0 < seconds < np.inf:
            raise InverseError(f"seconds is {seconds}; give the time since the last frame, above zero")
        moved = predicted(self.filter, now.belief, jnp.asarray(seconds, frame.dtype))
        now = replace(now, belief=moved)
        update = self._update(moved, frame, pads, seconds)
        if self._is_unexpected(now, update):
            now, update = self._explained(now, update, frame, pads, seconds)
            now = replace(now, since=0, misfit=float(update.misfit))
        else:
            now = replace(now, since=now.since + 1)
        return self._without_faint(replace(now, belief=update.belief), np.asarray(update.loudness))

    # --- one frame

    def _frame(self, dv: Float[ArrayLike, " readings"]) -> Float[Array, " readings"]:
        frame, readings = jnp.asarray(dv, self.filter.places.dtype), self.filter.finder.readings
        if frame.shape != (readings,):
            raise InverseError(f"dv has shape {frame.shape}; give one frame of {readings} readings")
        return frame

    def _pads(self, forces: Float[ArrayLike, " pads"] | None, errors: Float[ArrayLike, " pads"] | None) -> Pads:
        count = self.filter.sheet.pad_area.shape[1]
        if forces is None:
            return Pads(jnp.zeros(count), jnp.full(count, jnp.inf, float))  # as those that are known: no weak type
        force, error = np.asarray(forces, float), np.asarray(errors, float)
        if force.shape != (count,) or error.shape != (count,):
            raise InverseError(
                f"pad_forces and pad_errors have shapes {force.shape} and {error.shape}; give ({count},)"
            )
        known = np.isfinite(force) & np.isfinite(error)
        if not (error[known] > 0).all():
            raise InverseError("a pad has the standard error zero; give a number above zero, in newtons")
        return Pads(jnp.asarray(np.where(known, force, 0)), jnp.asarray(np.where(known, error, np.inf)))

    def _update(self, belief: Belief, frame: Array, pads: Pads, seconds: float, many: bool = False) -> Update:
        found: Update = updated(self.filter, belief, frame, pads, jnp.asarray(seconds), many=many)
        return found

    def _is_unexpected(self, now: Tracking, update: Update) -> bool:
        size, misfit, surprise = len(self.filter.compress), float(update.misfit), float(update.surprise)
        if surprise >= SURPRISING:
            return True
        unexpected = misfit > size + UNEXPECTED * np.sqrt(2 * size)
        return bool(unexpected and (now.since >= PATIENCE or misfit > WORSE * now.misfit))

    # --- events

    def _explained(
        self, now: Tracking, ordinary: Update, frame: Array, pads: Pads, seconds: float
    ) -> tuple[Tracking, Update]:
        """The contacts, and the update, under the events by which the frame is most probable.

        Evidence is that of one frame by itself: what the model errs by in this frame it has not told before.
        """
        alone = self._settings.persistence
        best = self._update(now.belief, frame, pads, alone, many=True)
        taken = ordinary
        for _ in range(EVENTS):
            left = np.asarray(unexplained(self.filter, best.belief, frame, pads))
            events = self._events(now, left, seconds)
            every = [(one, self._update(one.belief, frame, pads, alone, many=True)) for one in events]
            tried = [(event, update) for event, update in every if not _is_ripple(now, event, update)]
            if not tried:
                break
            event, update = max(tried, key=lambda pair: float(pair[1].evidence) + pair[0].prior)
            if not float(update.evidence) + event.prior > float(best.evidence):
                break
            now, best = self._happened(now, event), update
            taken = update
        return now, taken

    def _happened(self, now: Tracking, event: _Hypothesis) -> Tracking:
        faint = dict(zip(now.numbers, now.faint, strict=True))
        return replace(
            now,
            belief=event.belief,
            numbers=event.numbers,
            edges=event.edges,
            faint=tuple(faint.get(number, 0) for number in event.numbers),
            begun=max([now.begun, *event.numbers]),
        )

    def _events(self, now: Tracking, left: np.ndarray, seconds: float) -> Iterator[_Hypothesis]:
        rare, place = float(np.log(self._settings.birth_rate * seconds)), self._unexplained_place(left)
        if now.numbers:
            yield _Hypothesis(jumped(now.belief), now.numbers, now.edges, rare)
            yield from _as_edge(now, int(np.argmin(_distances(now, place))), rare)
        for k in range(len(now.numbers)):
            yield _Hypothesis(without(now.belief, k), *_left_out(now, k), rare)
        for j, k in combinations(range(len(now.numbers)), 2):
            numbers, edges = _left_out(replace(now, edges=(*now.edges[:j], True, *now.edges[j + 1 :])), k)
            yield _Hypothesis(joined(now.belief, j, k), numbers, edges, rare)
        if len(now.numbers) < self._settings.most:
            # The prior of a place is even over the skin, that of the fit is normal about where it begins.
            even = float(np.log(2 * np.pi * PLACE**2 / self._area))
            belief = self.with_contact(now.belief, place)
            yield _Hypothesis(belief, (*now.numbers, now.begun + 1), (*now.edges, False), rare + even)

    def _unexplained_place(self, left: np.ndarray) -> np.ndarray:
        """Where a contact would explain most of what is left, (2,) m."""
        finder = self.filter.finder
        place: np.ndarray = np.asarray(finder.starts)[int(np.argmax(np.asarray(finder.atoms) @ left)), :2]
        return place

    def with_contact(self, belief: Belief, place: np.ndarray) -> Belief:
        """The belief with a contact more, that begins about a place, (2,) m."""
        row, spread = np.zeros((2, SIZE))
        row[:4], spread[:4] = [*place, *self._usual], [PLACE, PLACE, *self._spread]
        spread[EDGE], spread[SHAPE], spread[VELOCITY] = ROUND, self._settings.shape, SPEED
        return inserted(belief, row, spread)

    # --- deaths

    def _without_faint(self, now: Tracking, loudness: np.ndarray) -> Tracking:
        faint = tuple(count + 1 if own < FAINT else 0 for count, own in zip(now.faint, loudness, strict=True))
        now = replace(now, faint=faint)
        for k in reversed(range(len(faint))):
            if faint[k] >= FAINT_FRAMES:
                numbers, edges = _left_out(now, k)
                rest = tuple(count for j, count in enumerate(now.faint) if j != k)
                now = replace(now, belief=without(now.belief, k), numbers=numbers, edges=edges, faint=rest)
        return now


def _as_edge(now: Tracking, k: int, rare: float) -> Iterator[_Hypothesis]:
    """Contact k as an edge in each of some directions, unless it is one."""
    if not now.edges[k]:
        edges = tuple(edge or j == k for j, edge in enumerate(now.edges))
        for angle in DIRECTIONS:
            prior = rare - float(np.log(len(DIRECTIONS)))
            yield _Hypothesis(lengthened(now.belief, k, angle), now.numbers, edges, prior)


def _distances(now: Tracking, place: np.ndarray) -> np.ndarray:
    away = np.asarray(now.belief.contacts)[:, :2] - place
    return np.asarray(np.linalg.norm(away, axis=1))


def _is_ripple(now: Tracking, event: _Hypothesis, update: Update) -> bool:
    """Whether a contact beside others would begin so weak that it may be an error of their model."""
    born = len(event.numbers) > len(now.numbers) > 0
    loudness = np.asarray(update.loudness)
    return born and bool(loudness[-1] < max(MIN_LOUDNESS, RIPPLE * loudness[:-1].sum()))


def _left_out(now: Tracking, k: int) -> tuple[tuple[int, ...], tuple[bool, ...]]:
    return now.numbers[:k] + now.numbers[k + 1 :], now.edges[:k] + now.edges[k + 1 :]


def prepare_tracker(
    model: Model,
    skin: Skin,
    settings: TrackerSettings | None = None,
    *,
    noise: Float[ArrayLike, "..."],
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> Tracker:
    """Prepare to follow contacts through the frames of a skin.

    Args:
        model: of the skin; a draft suffices where the model's error is a hundredth of the signal.
        skin: whose pads tell forces.
        settings: default `TrackerSettings()`.
        noise, untouched, sigma, channels: as for `prepare_contacts`.

    Raises:
        InverseError: as for `prepare_contacts`.
    """
    require_known("prepare_tracker", InverseError, model, noise, untouched, sigma, channels)
    settings = settings or TrackerSettings()
    sheet = sheet_of(model, untouched, sigma, channels)
    tracker = prepare_filter(model, skin, settings, noise, sheet, channels)
    return Tracker(tracker, settings, float(np.sum(np.asarray(model.areas))))
