"""Contacts followed through a recording, by `jaxeit.tracking`, as arrays of a file.

The untouched sheet and the noise are those of the session's own frames without contact. The forces on the pads and
their standard errors, by the calibration, are data of each frame beside its readings.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

import jaxeit as je
from jaxeit.tracking import (
    ContactLaw,
    LearnedLayer,
    Smoother,
    TimedTracks,
    Track,
    Tracker,
    TrackerSettings,
    Tracking,
)

from ..application.frame_blocks import FrameBlocks
from ..calibration import Calibration
from .learned.probes import learned_depth, pad_errors, probe_presses
from .load_windows import LOAD_FIDELITY
from .press_images import taken_for_even
from .quiet_frames import ENOUGH_FRAMES, QuietFrames

MIN_SECONDS = 1e-4  # between frames; those that arrive together bear about the same time
# Standard deviation of the gain that all readings share, as current source and amplifiers warm. Without it a drift of a
# ten-thousandth, which is as loud as the noise, is explained by weak and wide contacts.
GAIN_DRIFT = 1e-3

Rows = dict[str, np.ndarray]


class NotFollowed(ValueError):
    """The frames do not allow contacts to be followed."""


def prepare_calibrated_tracker(
    calibration: Calibration,
    untouched: Float[np.ndarray, " readings"],
    noise: Float[np.ndarray, " readings"] | None,
    settings: TrackerSettings | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> Tracker:
    """A tracker of the calibrated skin, whose loads spread and whose model errs as presses of the calibration show.

    Where the gain of the contact layer was learned, loads spread as they did then.

    Args:
        untouched: mean frame without contact, V.
        noise: standard deviation of the readings of a frame, V; readings without noise are left out. The frame as a
            whole may also drift by `GAIN_DRIFT`.
        settings: of the tracker; default: the usual.
        tell: called with a line if no sheet fits the untouched frame, or loads spread as at a depth.

    Raises:
        NotFollowed: if the noise is not known, or the presses of the calibration do not tell the model error.
    """
    if noise is None:
        raise NotFollowed("no frames without contact tell the noise")
    channels = np.asarray(calibration.recon.channels) & (noise > 0) & np.isfinite(noise)
    if not channels.any():
        raise NotFollowed("no reading has noise without contact, so none tells how sure it is")
    model = je.discretise(je.Scene(calibration.skin), LOAD_FIDELITY)
    errors = _covariance(np.where(channels, noise, 1.0), np.where(channels, untouched, 0.0))
    prepare = partial(
        je.tracking.prepare_tracker, model, calibration.skin, noise=errors, channels=channels, untouched=untouched
    )
    settings = TrackerSettings() if settings is None else settings
    try:
        tracker = prepare(settings)
    except je.imaging.InverseError as error:
        tell(f"note: {taken_for_even(error)}")
        prepare = partial(prepare, untouched=None)
        tracker = prepare(settings)
    if settings.loads.depth is None and (depth := learned_depth(calibration, tracker)):
        tell(f"presses of the calibration spread as at a depth of {1e3 * depth:.1f} mm in an elastic half-space")
        tracker = prepare(_at_depth(settings, depth))
    return _with_model_error(tracker, calibration)


def _at_depth(settings: TrackerSettings, depth: float) -> TrackerSettings:
    """The settings with a sheet at a depth, m."""
    return replace(settings, loads=replace(settings.loads, depth=depth))


def _covariance(noise: Float[np.ndarray, " n"], untouched: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Covariance of the readings of a frame, V^2: the noise of each, and a gain that all share."""
    drift = GAIN_DRIFT * untouched
    return np.diag(noise**2) + np.outer(drift, drift)


def _with_model_error(tracker: Tracker, calibration: Calibration) -> Tracker:
    """The tracker with the model error that presses of the calibration show, or its own where the file has none."""
    presses = probe_presses(calibration)
    if presses is None:
        return tracker
    try:
        return je.tracking.fit_model_error(tracker, *presses)
    except je.imaging.InverseError as error:
        raise NotFollowed(f"the presses of the calibration do not tell how far the model errs: {error}") from error


def quiet_tracker(
    calibration: Calibration,
    blocks: FrameBlocks,
    settings: TrackerSettings | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> Tracker:
    """A tracker with the untouched sheet and the noise of the first frames without contact.

    Args:
        settings, tell: as for `prepare_calibrated_tracker`.

    Raises:
        NotFollowed: if there are none.
    """
    quiet = QuietFrames(calibration.recon.readings)
    for block in blocks:
        quiet.add(block.frames, block.change, block.loaded(calibration))
        if quiet.count >= ENOUGH_FRAMES:
            break
    return prepare_calibrated_tracker(calibration, quiet.untouched, quiet.noise, settings, tell)


class ContactTracks:
    """Follows contacts block by block, and gives back rows of `TRACK_ARRAYS`, one for each contact of a frame.

    Args:
        smooth: each frame is told by later ones too.
        layer: gain of the contact layer, as it was learned before.
        law: by which readings tell the force where no pad does; default: that of the tracker.
        watch: called after each frame, with what is known then, the change of the frame, and the errors of the pads.
    """

    def __init__(
        self,
        tracker: Tracker,
        *,
        smooth: bool = True,
        layer: LearnedLayer | None = None,
        law: ContactLaw | None = None,
        watch: Callable[[Tracking, np.ndarray, np.ndarray], None] = lambda *_: None,
    ):
        self._tracker, self._now = tracker, tracker.start(layer)
        self._smoother = Smoother(tracker) if smooth else None
        self._law, self._watch = law, watch
        self._errors: deque[tuple[int, np.ndarray]] = deque()  # of pads, of frames that are still to be smoothed
        self._last: int | None = None
        self._lives: dict[int, tuple[int, int]] = {}
        self._most = 0

    def add(
        self,
        time: Int[np.ndarray, " n"],
        change: Float[np.ndarray, "n readings"],
        force: Float[np.ndarray, "n pads"],
        error: Float[np.ndarray, "n pads"],
    ) -> Rows:
        """Follow contacts through a block: times ns, change of the frames V, forces on the pads and their errors N."""
        return self._rows(
            [one for row in zip(time.tolist(), change, force, error, strict=True) for one in self._followed(*row)]
        )

    def learned(self) -> LearnedLayer:
        """What all contacts so far have told of the gain of the contact layer."""
        return self._tracker.learned(self._now)

    def end(self) -> Rows:
        """The rows that are left."""
        return self._rows([] if self._smoother is None else self._smoother.end())

    def _followed(self, time: int, change: np.ndarray, force: np.ndarray, error: np.ndarray) -> Iterable[TimedTracks]:
        seconds = MIN_SECONDS if self._last is None else max((time - self._last) / 1e9, MIN_SECONDS)
        self._last = time
        errors = pad_errors(force, error)
        self._now = self._tracker.step(self._now, change, seconds, force, errors)
        self._watch(self._now, change, errors)
        if self._law is not None:
            self._errors.append((time, errors))
        if self._smoother is None:
            return [TimedTracks(self._last, self._now.tracks)]
        return list(self._smoother.add(self._last, self._now, seconds))

    def _by_law(self, found: TimedTracks) -> TimedTracks:
        """With the force by the law of each contact of which no pad tells the force."""
        if self._law is None:
            return found
        time, errors = self._errors.popleft()
        assert time == found.time
        told = self._tracker.told_by_pads(found.tracks, errors)
        return found._replace(tracks=self._law.without_pads(found.tracks, told))

    def _rows(self, found: Iterable[TimedTracks]) -> Rows:
        found = map(self._by_law, found)
        rows = [_row(time, track) for time, tracks in found for track in self._noted(time, tracks)]
        return {
            name: np.array([row[name] for row in rows]).reshape(-1, *about.shape)
            for name, about in TRACK_ARRAYS.items()
        }

    def _noted(self, time: int, tracks: tuple[Track, ...]) -> Iterator[Track]:
        self._most = max(self._most, len(tracks))
        for track in tracks:
            self._lives[track.number] = (self._lives.get(track.number, (time,))[0], time)
            yield track

    def render(self) -> str:
        """How many contacts there were, for how long and when, in one line."""
        if not self._lives:
            return "contacts: none touched the skin"
        begin, end = np.array(list(self._lives.values())).T / 1e9
        seconds = np.sort(end - begin)
        span = f"{begin.min():.2f} to {end.max():.2f} s"
        return (
            f"contacts: {len(seconds)} followed from {span}, at most {self._most} at once, for {seconds[0]:.2f} to "
            f"{seconds[-1]:.2f} s (median {np.median(seconds):.2f} s)"
        )


class TrackArray(NamedTuple):
    """An array with one row for each contact of a frame: shape of a row, unit, meaning and type."""

    shape: tuple[int, ...]
    units: str
    meaning: str
    dtype: str = "f8"


TRACK_ARRAYS = {
    "time": TrackArray((), "ns", "of the frame, since time_epoch_utc", "i8"),
    "number": TrackArray((), "1", "of the contact, which it keeps while it lives", "i8"),
    "position": TrackArray((2,), "m", "in the sheet's flat coordinates; of an edge, its middle"),
    "position_covariance": TrackArray((2, 2), "m2", "of the position"),
    "width": TrackArray((), "m", "standard deviation of the load, across an edge"),
    "force": TrackArray((), "N", "of the contact"),
    "force_se": TrackArray((), "N", "standard error of the force"),
    "half": TrackArray((2,), "m", "from the middle of an edge to its end; zero for other contacts"),
    "velocity": TrackArray((2,), "m/s", "of the position"),
}


def _row(time: int, track: Track) -> dict[str, object]:
    return {
        "time": time,
        "number": track.number,
        "position": track.position,
        "position_covariance": track.covariance,
        "width": track.width,
        "force": track.force,
        "force_se": track.force * track.log_force_error,
        "half": track.half,
        "velocity": track.velocity,
    }
