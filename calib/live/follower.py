"""Contacts followed through the frames of a live view, by `jaxeit.tracking`."""

import time
from collections.abc import Callable

import numpy as np

from jaxeit.tracking import LearnedLayer, Track, Tracker, TrackerSettings, Tracking, compile_tracker

from ..calibration.calibration import Calibration
from ..calibration.localisation.contact_tracks import MIN_SECONDS, prepare_calibrated_tracker
from ..calibration.localisation.learned.probes import pad_errors
from ..calibration.localisation.quiet_frames import QuietFrames
from ..check.placement import noted, placement_note
from .results import TouchEstimates

FIRST_SECONDS = 0.01  # before the first frame that is followed
# Pieces of a look into an unexpected frame that follow one frame, at most; and the time, s, after which a piece is done
# even if the next frame waits for it.
PIECES, MAX_PAUSE = 8, 0.012
SMOOTHING = 0.2  # weight of a piece in the mean time that one takes

Prepare = Callable[[Calibration, np.ndarray, np.ndarray | None], Tracker]


class LiveFollower:
    """Follows contacts from frame to frame; they keep their numbers also where frames were dropped or are late.

    The tracker is prepared once, with the sheet and the noise of the first rest, and all its programs are compiled
    then: that takes longer than a frame, and no later frame waits for it.
    """

    def __init__(
        self,
        calibration: Calibration,
        prepare: Prepare = prepare_calibrated_tracker,
        most: int = TrackerSettings.most,  # of the class: an object would start JAX
    ):
        self._calibration, self._prepare, self.most = calibration, prepare, most
        self._tracker: Tracker | None = None
        self._now: Tracking | None = None
        self._layer, self.doubt = calibration.layer, noted(calibration.notes)
        self._last: int | None = None
        self._looked, self._piece = 0.0, 0.0  # s: end of the last piece of a look, and how long pieces take

    @property
    def ready(self) -> bool:
        """Whether the tracker is prepared."""
        return self._tracker is not None

    def prepare(self, resting: np.ndarray) -> None:
        """Prepare the tracker from frames without contact (n, readings) V, and compile its programs.

        Raises:
            NotFollowed: if the frames do not tell the noise.
        """
        quiet = QuietFrames(resting.shape[1])
        untouched = np.zeros(len(resting), bool)
        quiet.add(resting, resting, untouched)
        spread = QuietFrames(resting.shape[1])
        spread.add(resting, resting - quiet.untouched, untouched)
        self._tracker = self._prepare(self._calibration, quiet.untouched, spread.noise)
        compile_tracker(self._tracker)
        used = np.asarray(self._calibration.recon.channels)
        self.doubt = placement_note(self._calibration.skin, quiet.untouched, used)
        self.restart()

    @property
    def layer(self) -> LearnedLayer | None:
        """The gain of the contact layer as contacts that have lifted told it: the same object until others have."""
        return self._layer if self._now is None else self._now.layer

    def learned(self) -> LearnedLayer | None:
        """The gain of the contact layer, as the calibration knows it and contacts have told it since; None: unknown."""
        if self._tracker is None or self._now is None:
            return self._layer
        return self._tracker.learned(self._now)

    def restart(self) -> None:
        """Forget the contacts, as after a new measurement of the rest levels, but not what they told of the layer."""
        self._layer = self.learned()
        self._now, self._last = None, None

    def step(self, change: np.ndarray, force: np.ndarray, error: np.ndarray, host: int) -> tuple[Track, ...]:
        """The contacts after a frame.

        Args:
            change: of the frame against the rest level, (readings,) V.
            force, error: on the pads and their standard errors, (pads,) N; NaN: not known.
            host: time of arrival, ns.
        """
        assert self._tracker is not None
        seconds = FIRST_SECONDS if self._last is None else max((host - self._last) / 1e9, MIN_SECONDS)
        before = self._tracker.start(self._layer) if self._now is None else self._now
        errors = pad_errors(force, error)
        self._now = self._tracker.step(before, change, seconds, force, errors, whole=False)
        self._last = host
        tracks, law = self._now.tracks, self._calibration.contact_law
        if law is not None and law.is_better:
            tracks = law.without_pads(tracks, self._tracker.told_by_pads(tracks, errors))
        return self._on_sheet(tracks)

    def _on_sheet(self, tracks: tuple[Track, ...]) -> tuple[Track, ...]:
        """Without those that have left the sheet, which happens while an unexpected frame is looked into."""
        low, high = self._calibration.skin.domain.bounds
        return tuple(one for one in tracks if (low <= one.position).all() and (one.position <= high).all())

    def use_spare_time(self, seconds: float) -> None:
        """Look further into an unexpected frame, as far as the time until the next frame allows, or `MAX_PAUSE` asks.

        Contacts that are found, or found to be others, are those of the next frame.
        """
        end = time.monotonic() + seconds
        for _ in range(PIECES):
            begin = time.monotonic()
            if self._tracker is None or self._now is None or self._now.backlog is None:
                return
            if begin + self._piece > end and begin - self._looked < MAX_PAUSE:
                return
            self._now = self._tracker.look(self._now)
            self._looked = time.monotonic()
            self._piece += SMOOTHING * (self._looked - begin - self._piece)


def followed_touches(tracks: tuple[Track, ...]) -> TouchEstimates:
    """Tracks as results of a frame."""
    force = np.array([one.force for one in tracks])
    return TouchEstimates(
        position=np.array([one.position for one in tracks]).reshape(-1, 2),
        covariance=np.array([one.covariance for one in tracks]).reshape(-1, 2, 2),
        sure=np.ones(len(tracks), bool),
        age=0,
        number=np.array([one.number for one in tracks], int),
        force=force,
        force_error=force * np.array([one.log_force_error for one in tracks]),
        half=np.array([one.half for one in tracks]).reshape(-1, 2),
    )


def padded(tracks: tuple[Track, ...], most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (1, most, 2), widths and forces (1, most) of tracks; NaN, and zero force, for absent ones."""
    position, width, force = np.full((1, most, 2), np.nan), np.full((1, most), np.nan), np.zeros((1, most))
    for k, one in enumerate(tracks):
        position[0, k], width[0, k], force[0, k] = one.position, one.width, one.force
    return position, width, force
