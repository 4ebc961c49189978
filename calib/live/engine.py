"""Compute forces, force map and contacts of one frame after the other, by programs compiled for one frame.

The force map of a frame waits for nothing else. Contacts take several times as long to fit. They are fitted to the
newest frame if there is time before the next one is due (`Engine.use_spare_time`), and are used until the next fit.
Where contacts are followed instead (`follower`), each frame has contacts of its own, and its result waits for them;
what may have happened to them is looked into in the time that is left. A network that was trained for the skin says in
each touched frame what touches it, in a fraction of a millisecond.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.tracking import LearnedLayer

from ..calibration.application.force_maps import force_model
from ..calibration.calibration import Calibration
from ..calibration.localisation.ellipses import placement_covariance
from ..check.placement import noted
from ..fitting.curves.play_operators import remembered
from ..fitting.fields import Places
from ..presses.streams import finite_mean
from .follower import LiveFollower, followed_touches
from .frame_programs import FramePrograms
from .plausibility import NO_FAULT, SILENT_PADS, PadWatch, RestCheck
from .recalibrator import LiveRecalibrator
from .results import NO_TOUCHES, FrameResult, KindEstimate

TOUCH_SIGNIFICANCE = 3.0  # a force above this many standard errors is a touch
MAX_SEARCH_DELAY = 0.1  # s; then contacts are fitted even if a frame is dropped for it
MAX_NEGATIVE_TIME = 1.0  # s below zero on a skin that nothing presses, after which the rest levels must be wrong
REST_IMAGES = 8  # frames at rest, between which images of changes are made
MAX_PLACE_AGE = 0.3  # s; older contacts do not describe the present frame

MEASURING = "measuring the rest levels: do not touch the skin"
PREPARING = "preparing to follow contacts, once: frames are left out until then"


class ReceivedFrame(NamedTuple):
    """A frame of the stream that sets the pace, the mean of the other stream since the frame before, and arrival (ns).

    | field  | of a skin            | of a sensor without EIT                                                       |
    |--------|----------------------|-------------------------------------------------------------------------------|
    | values | voltages (readings,) V | its channels                                                                |
    | beside | pressures (pads,) Pa | place of the stage (3,) m, if the calibration needs it; otherwise empty (0,) |
    | host   | time of arrival, ns  | time of arrival, ns                                                           |
    """

    values: np.ndarray
    beside: np.ndarray
    host: int


class RestAverage:
    """Rest levels: means of voltages and pressures over `seconds` of frames without contact, of finite values only.

    ``levels`` are these means: voltages (readings,) V and pressures (pads,) Pa, or None until the time is over.
    ``change`` (pads,) Pa is the mean pressure of the second half of the frames less that of the first, and ``frames``
    (n, readings) V are the frames themselves.
    """

    def __init__(self, seconds: float):
        self._seconds = seconds
        self._since: int | None = None
        self._rows: list[tuple[np.ndarray, np.ndarray, int]] = []
        self.levels: tuple[np.ndarray, np.ndarray] | None = None
        self.change = np.zeros(0)
        self.frames = np.zeros((0, 0))

    def add(self, arrival: ReceivedFrame) -> None:
        """Add a frame without contact."""
        self._since = arrival.host if self._since is None else self._since
        self._rows.append((arrival.values, arrival.beside, arrival.host))
        if arrival.host - self._since >= self._seconds * 1e9:
            voltages, pressures, _ = zip(*self._rows, strict=True)
            first, second = np.array_split(np.stack(pressures), 2)
            self.frames = np.stack(voltages)
            self.levels = finite_mean(self.frames), finite_mean(np.stack(pressures))
            self.change = finite_mean(second) - finite_mean(first) if len(second) else np.zeros_like(pressures[0])

    def slide(self) -> None:
        """Drop the first half of the frames, and wait for as many new ones."""
        self._rows = self._rows[-(-len(self._rows) // 2) :]
        self._since, self.levels = (self._rows[0][2] if self._rows else None), None


class Engine:
    """Turns frames into results with one calibration. Only the thread that created it may use it.

    Example:
        import time

        import numpy as np

        from calib.live import Engine, ReceivedFrame

        engine = Engine(mine, rest=0.0)  # frame by frame, without devices
        for k in range(3):
            # V, Pa
            frame = ReceivedFrame(np.zeros(550), np.array([0.0, 0.0, 500.0 * k, 0.0]), time.monotonic_ns())
            result = engine.step(frame)
        print(result.force, result.to_json()[:80])
    """

    def __init__(
        self,
        calibration: Calibration,
        rest: float = 2.0,
        programs: Callable[..., FramePrograms] = FramePrograms,
        *,
        recalibrator: LiveRecalibrator | None = None,
        follower: LiveFollower | None = None,
        proposal: je.contacts.Proposal | None = None,
        check: RestCheck | None = None,
    ):
        """`proposal`: tells what touches the skin; None: this is not told. `check`: of rest levels; None: none."""
        self._rest, self._proposal, self._check = rest, proposal, check
        self._rest_fault, self._watch = NO_FAULT, PadWatch.of(calibration)
        self._rest_levels = RestAverage(rest)
        self._number = 0
        self._negative_since: int | None = None
        self.restless = False
        recon = calibration.recon
        self._used_readings, self._centres = np.asarray(recon.channels), np.asarray(recon.centres)
        self._pad_weights = np.asarray(calibration.masks.weights)
        self._recalibrator, self._follower = recalibrator, follower
        self._doubt = noted(calibration.notes)
        self._multiple = calibration.pads.multiple
        self._model = force_model(calibration) if recalibrator is None else recalibrator.moved(force_model(calibration))
        self._programs = programs(self._model) if follower is None else programs(self._model, follower.most)
        self._programs.warm_up()
        self._before = np.zeros((1, len(self._pad_weights)))
        self._waiting_frame: np.ndarray | None = None  # a touched frame whose contacts are not fitted yet
        self._places, self._touches, self._search_end = self._programs.nowhere, NO_TOUCHES, 0.0
        fits = calibration.locator is not None
        self._placement_covariance = placement_covariance(calibration) if fits else np.zeros((2, 2))
        self._search_time = 0.0
        self.unsearched = 0

    @property
    def resting(self) -> bool:
        """Whether the rest levels are still being measured."""
        return self._rest_levels.levels is None

    @property
    def state(self) -> str:
        """What the engine does now, for the operator."""
        if not self.resting:
            return "running" if self._follower is None or self._follower.ready else PREPARING
        return "waiting for the skin to be at rest: do not touch it" if self.restless else MEASURING

    @property
    def health(self) -> str:
        """How far off the calibration is, if it is being recalibrated, and what makes places doubtful."""
        moved = "" if self._recalibrator is None else self._recalibrator.health
        return "; ".join(filter(None, (moved, self.doubt)))

    @property
    def doubt(self) -> str:
        """What is to be said of the places of the electrodes: of the first rest, or by the calibration."""
        return self._doubt if self._follower is None else self._follower.doubt

    @property
    def layer(self) -> LearnedLayer | None:
        """What is known of the gain of the contact layer; None: nothing, or contacts are not followed."""
        return None if self._follower is None else self._follower.layer

    @property
    def faults(self) -> tuple[str, ...]:
        """What cannot be true in the streams: of the newest rest levels, and of contacts since."""
        return tuple(filter(None, (self._rest_fault.words, SILENT_PADS if self._pads_are_silent else "")))

    @property
    def _pads_are_silent(self) -> bool:
        return self._watch is not None and self._watch.silent

    def tare(self) -> None:
        """Measure the rest levels again."""
        self._rest_levels, self._negative_since, self.restless = RestAverage(self._rest), None, False
        if self._recalibrator is not None:
            self._recalibrator.tared()
        if self._follower is not None:
            self._follower.restart()

    def has_wrong_zero(self, now: int) -> bool:
        """Whether pads read below zero for so long, at `now` (ns), that the skin was pressed when zero was measured."""
        return self._negative_since is not None and now - self._negative_since > MAX_NEGATIVE_TIME * 1e9

    def _add_rest(self, arrival: ReceivedFrame) -> None:
        """Add a frame to the rest levels, and go on measuring if the skin was pressed or released meanwhile."""
        self._rest_levels.add(arrival)
        if self._rest_levels.levels is not None:
            change = np.nan_to_num(self._rest_levels.change)
            found = self._programs.map(np.zeros(arrival.values.size), change, self._programs.nowhere, self._before)
            self.restless = bool((found.loaded | found.negative).any())
            if self.restless:
                self._rest_levels.slide()
            else:
                self._look_at_rest()

    def _look_at_rest(self) -> None:
        """Ask once whether the new rest levels can be true, and see the noise of images: silent pads tell no rest."""
        assert self._rest_levels.levels is not None
        voltages, pressures = self._rest_levels.levels
        if self._check is not None:
            self._rest_fault = self._check(voltages)
        if self._watch is not None:
            steps, still = np.diff(self._rest_levels.frames[-REST_IMAGES:], axis=0), np.zeros_like(pressures)
            images = [self._programs.map(row, still, self._programs.nowhere, self._before).image for row in steps]
            self._watch.begin(max((float(np.abs(image).max()) for image in images), default=0.0))

    def _note_negative(self, negative: np.ndarray, loaded: np.ndarray, now: int) -> None:
        """Note since when pads read below zero while none is pressed."""
        if not negative.any() or loaded.any():
            self._negative_since = None
        elif self._negative_since is None:
            self._negative_since = now

    def pressed(self, arrival: ReceivedFrame) -> np.ndarray:
        """Change of pressure on each pad (pads,) Pa; only once the rest levels are measured."""
        assert self._rest_levels.levels is not None
        offset = 0.0 if self._recalibrator is None else self._recalibrator.offset
        return np.asarray(arrival.beside - self._rest_levels.levels[1] - offset)

    def _changed(self, arrival: ReceivedFrame) -> np.ndarray:
        """Change of each reading (readings,) V; only once the rest levels are measured."""
        assert self._rest_levels.levels is not None
        return np.asarray(arrival.values - self._rest_levels.levels[0])

    def step(self, arrival: ReceivedFrame, dropped: int = 0) -> FrameResult | None:
        """Process one frame; None while the rest levels are being measured, and once contacts can be followed."""
        if not self._is_ready(arrival):
            return None
        frame, pressure = self._changed(arrival), self.pressed(arrival)
        lost, silent = ~np.isfinite(frame), ~np.isfinite(pressure)
        pressed = np.where(silent, 0.0, pressure)
        found = self._programs.map(frame, pressed, self._current_places(), self._before)
        self._remember(pressure)
        self._schedule_search(frame, bool(found.loaded.any()))
        self._recalibrate(frame, pressure, bool(found.loaded.any()), arrival.host)
        self._note_negative(found.negative & ~silent, found.loaded & ~silent, arrival.host)
        if self._watch is not None:
            self._watch.add(found.image, bool((found.loaded | found.negative | silent).any()), arrival.host)
        force = np.where(silent, np.nan, found.force)
        error = np.where(silent, np.nan, found.standard_error)
        self._follow(frame, force, error, arrival.host)
        self._number += 1
        return FrameResult(
            number=self._number,
            host=arrival.host,
            latency=(time.monotonic_ns() - arrival.host) / 1e9,
            force=force,
            standard_error=error,
            half_width=self._multiple * error,
            valid=found.valid & ~silent & ~found.negative & (not (self._rest_fault.refused or self._pads_are_silent)),
            centre=self._centre(found.map, force > TOUCH_SIGNIFICANCE * error),
            map=found.map,
            image=found.image,
            missing=int((lost & self._used_readings).sum()),
            dropped=dropped,
            touches=self._touches,
            unsearched=self.unsearched,
            kinds=self._kinds(frame, force, bool(found.loaded.any())),
            faults=self.faults,
        )

    def _is_ready(self, arrival: ReceivedFrame) -> bool:
        """Whether this frame can be processed; otherwise it is a frame at rest, or contacts cannot be followed yet."""
        if self._rest_levels.levels is None:
            self._add_rest(arrival)
            return False
        if self._follower is not None and not self._follower.ready:
            self._follower.prepare(self._rest_levels.frames)
            return False
        return True

    def _remember(self, pressure: np.ndarray) -> None:
        """Keep a pressure for a curve with memory."""
        if self._model.remembers:
            own = np.asarray(self._model.moved(self._programs.gains).pads.own(jnp.asarray(pressure[None])))
            self._before = remembered(np.concatenate([self._before, own]))

    def _kinds(self, frame: np.ndarray, force: np.ndarray, touched: bool) -> KindEstimate | None:
        """What touches the skin; readings that the calibration leaves out are missing."""
        if self._proposal is None or not touched:
            return None
        found = self._proposal(np.where(self._used_readings, frame, np.nan), force)
        return KindEstimate(found.probability, found.outside)

    def _follow(self, frame: np.ndarray, force: np.ndarray, error: np.ndarray, now: int) -> None:
        """Follow contacts to this frame; the next frame's forces are corrected by their places."""
        if self._follower is not None:
            tracks = self._follower.step(frame, force, error, now)
            self._touches, self._places = followed_touches(tracks), self._programs.placed(tracks)
            self._search_end = time.monotonic()

    def _recalibrate(self, frame: np.ndarray, pressure: np.ndarray, loaded: bool, now: int) -> None:
        """Let the recalibrator see a frame, and use its gains from the next frame on."""
        if self._recalibrator is not None:
            self._recalibrator.add(frame, pressure, loaded, now)
            self._programs.gains = self._recalibrator.gains

    def _current_places(self) -> Places:
        return self._places if time.monotonic() - self._search_end < MAX_PLACE_AGE else self._programs.nowhere

    def _schedule_search(self, frame: np.ndarray, touched: bool) -> None:
        """Keep a touched frame for the next fit of contacts, and forget contacts without a touch."""
        if self._touches.age is not None:
            self._touches = replace(self._touches, age=self._touches.age + 1)
        if not self._programs.searches:
            return
        self.unsearched += self._waiting_frame is not None
        self._waiting_frame = frame if touched else None
        if not touched:
            self._places, self._touches = self._programs.nowhere, replace(NO_TOUCHES, age=0)

    def use_spare_time(self, seconds: float) -> None:
        """Fit contacts of the newest frame if `seconds`, the time until the next frame, allow it; then recalibrate.

        Where contacts are followed: look further into a frame that was not expected.
        """
        if self._follower is not None:
            self._follower.use_spare_time(seconds)
        if self._recalibrator is not None and self._waiting_frame is None:
            self._recalibrator.use_spare_time()
        if self._waiting_frame is not None and (
            seconds > self._search_time or time.monotonic() - self._search_end > MAX_SEARCH_DELAY
        ):
            begin = time.monotonic()
            self._places, touches = self._programs.search(self._waiting_frame)
            self._touches = replace(touches, covariance=touches.covariance + self._placement_covariance)
            self._search_end, self._waiting_frame = time.monotonic(), None
            self._search_time = max(self._search_end - begin, 0.95 * self._search_time)

    def _centre(self, image: np.ndarray, touched: np.ndarray) -> np.ndarray:
        """Mean position (pads, 2) m of the force on each touched pad; NaN on the others."""
        each = self._pad_weights * np.maximum(image, 0.0)
        total = each.sum(1)
        ok = touched & (total > 0)
        middle = each @ self._centres / np.where(ok, total, 1.0)[:, None]
        return np.where(ok[:, None], middle, np.nan)
