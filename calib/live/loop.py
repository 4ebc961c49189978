"""Live force maps: each frame becomes a force map as it arrives. One thread owns JAX; the others only move bytes.

Rest levels are the means of the first seconds (`engine`), and are measured again on request.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

import jaxeit as je
from jaxeit.registry import limited, require_limits

from ..calibration.calibration import Calibration
from ..calibration.localisation.contact_tracks import NotFollowed, prepare_calibrated_tracker
from ..calibration.localisation.proposals import ProposalChoice, chosen_proposal
from ..calibration.logs.calibration import LogCalibration
from ..record.intake import NullSink, RecordSink, explain_reopening, explain_silence
from ..record.plan import RecordingPlan
from ..record.priority import real_time
from ..record.recorder import Recorder
from ..record.sources import Source
from .engine import Engine, ReceivedFrame
from .follower import LiveFollower
from .frame_queue import FrameQueue
from .log_engine import LogEngine
from .plausibility import rest_check
from .recalibrator import LiveRecalibrator
from .results import FrameResult, Result
from .scan_control import ScanDirector, prepare_director

COMPILING = "compiling the programs of this calibration, before the devices are asked: up to a minute the first time"
CHOOSING = "choosing the readings for each place of the skin"
STOPPED = "stopped before the devices were asked"


class _Stopped(Exception):
    """A stop was requested while programs were compiled."""


class LiveError(ValueError):
    """The streams do not fit the calibration, do not begin, or fail; or they do not allow contacts to be followed.

    Example:
        from calib.live import LiveError

        try:
            run_live(mine, plan, sources[::-1], [], control)  # pressure before eit
        except LiveError as error:
            print(error)
    """


def _ignore(line: str) -> None:
    """Tell nobody."""


@dataclass
class LiveControl:
    """Controls of a running live view (stop, measure rest levels again), and its state for viewers.

    | field     | meaning                                                                                  |
    |-----------|------------------------------------------------------------------------------------------|
    | stop      | event that ends the view                                                                 |
    | tare      | event that has the rest levels measured again                                            |
    | state     | what the view does now, in words                                                         |
    | lost      | number of frames that were sent and did not arrive                                       |
    | health    | of the calibration, in words, while it is being recalibrated or its places are doubtful  |
    | doubt     | about places of contacts, in words                                                       |
    | faults    | what cannot be true in the streams or hinders their links, in words                      |
    | layer     | gain of the contact layer, where contacts are followed; another object once it has changed |
    | simulated | whether a device reports that its values are simulated                                   |
    | warn      | called with what the operator should know                                                |
    """

    stop: threading.Event = field(default_factory=threading.Event)
    tare: threading.Event = field(default_factory=threading.Event)
    state: str = COMPILING
    lost: int = 0
    health: str = ""
    doubt: str = ""
    faults: tuple[str, ...] = ()
    layer: je.tracking.LearnedLayer | None = None
    simulated: bool = False
    warn: Callable[[str], object] = _ignore


Publish = Callable[[Result], object]


@dataclass(frozen=True)
class LiveSettings:
    """How frames are processed.

    | field        | meaning                                                                      | default | unit |
    |--------------|------------------------------------------------------------------------------|---------|------|
    | rest         | duration without contact at the beginning, in which rest levels are measured | 2       | s    |
    | wait         | time within which the devices must begin                                     | 10      | s    |
    | seconds      | duration, counted from the first frame; None: until a stop is requested      | None    | s    |
    | event_driven | whether to request readings frame by frame, which the device must support    | False   |      |
    | realtime     | whether to use real-time scheduling once everything is compiled              | False   |      |
    | recalibrate  | whether zero and gains of the pads follow their drift                        | False   |      |
    | track        | whether contacts are followed from frame to frame; or how                    | False   |      |
    | proposal     | network that tells what touches the skin; None: none                         | shipped |      |
    | moved        | calibration file to which the moved calibration is written; None: none       | None    |      |
    """

    rest: float = limited(2.0, above=0)
    wait: float = limited(10.0, least=0)
    seconds: float | None = None
    event_driven: bool = False
    realtime: bool = False
    recalibrate: bool = False
    track: bool | je.tracking.TrackerSettings = False
    proposal: ProposalChoice = je.contacts.shipped_proposal
    moved: str | Path | None = None

    def __post_init__(self) -> None:
        require_limits(self)


def run_live(
    calibration: Calibration | LogCalibration,
    plan: RecordingPlan,
    sources: Sequence[Source],
    viewers: Sequence[Publish],
    control: LiveControl,
    settings: LiveSettings | None = None,
    *,
    log: RecordSink | None = None,
    begun: Callable[[], object] = lambda: None,
) -> int:
    """Process frames until a stop is requested or the time is over; returns the number of processed frames.

    Args:
        plan, sources: of the streams eit and pressure, in this order, from `plan_recording`; of a log's calibration,
            of its sensor and, if the calibration needs the place, of the stage.
        viewers: functions that are called with each result; they must return at once.
        control: lets other threads stop the loop or measure rest levels again, and shows them its state.
        settings: how frames are processed.
        log: destination of all frames as they arrive, such as a journal (`session_journal`); default: none.
        begun: called when everything is compiled and the devices are connected.

    Raises:
        LiveError: if the streams do not fit the calibration, do not begin, or fail, or end before there is a result;
            if contacts are to be followed and the frames at rest do not tell the noise.
        InverseError: if the network was trained for another skin.
        PriorityError: if real-time scheduling is refused.
    """
    settings = settings or LiveSettings()
    control.state = COMPILING
    try:
        engine, recalibrator = _engine(calibration, sources, control, settings)
        _go_on(control)
    except _Stopped:
        return 0
    queue = FrameQueue(*(source.plan for source in sources))
    recorder = Recorder(plan, sources, log or NullSink(), queue.put)
    director = None
    if settings.event_driven:
        control.state = CHOOSING
        director = prepare_director(cast(Calibration, calibration), sources[0].plan.number, recorder.receivers[0].send)
    control.state = f"waiting for the first frame of {' and '.join(source.plan.name for source in sources)}"
    with real_time(settings.realtime), recorder:
        begun()
        count = _process_frames(engine, queue, recorder, viewers, control, settings, director)
    if recalibrator is not None:
        control.warn(recalibrator.health)
        recalibrator.save()
    if recorder.failure is not None:
        raise LiveError(f"live: {recorder.failure}") from recorder.failure
    if not count and not control.stop.is_set():
        last = "; ".join((control.state, *control.faults))
        raise LiveError(
            f"live: ended without a result; its last state: {last}; give it more time (--seconds), or look at what the "
            "devices send (jaxeit record)"
        )
    return count


def _engine(
    calibration: Calibration | LogCalibration, sources: Sequence[Source], control: LiveControl, settings: LiveSettings
) -> tuple[Engine | LogEngine, LiveRecalibrator | None]:
    """The engine, and what moves its calibration, if that was asked for; refuses streams that do not fit."""
    if isinstance(calibration, LogCalibration):
        _check_log(calibration, sources, settings)
        return LogEngine(calibration, settings.rest), None
    _check(calibration, sources)
    _check_rest(settings)
    _go_on(control)
    follower = _follower(calibration, settings.track, control.warn) if settings.track else None
    _go_on(control)
    recalibrator = None
    if settings.recalibrate:
        layer = None if follower is None else follower.learned
        recalibrator = LiveRecalibrator(calibration, settings.moved, tell=control.warn, layer=layer)
    _go_on(control)
    proposal = chosen_proposal(settings.proposal, calibration.skin, control.warn)
    check = rest_check(calibration)
    _go_on(control)
    engine = Engine(
        calibration,
        settings.rest,
        recalibrator=recalibrator,
        follower=follower,
        proposal=proposal,
        check=check,
    )
    return engine, recalibrator


def _go_on(control: LiveControl) -> None:
    """End what prepares the view if a stop was requested meanwhile."""
    if control.stop.is_set():
        control.state = STOPPED
        raise _Stopped


def _check(calibration: Calibration, sources: Sequence[Source]) -> None:
    eit, pressure = (source.plan for source in sources)
    readings, pads = calibration.recon.readings, len(calibration.skin.pads)
    if (eit.channels, pressure.channels) != (readings, pads):
        what = f"{eit.channels} readings and {pressure.channels} pressures"
        raise LiveError(
            f"live: {what}, but this calibration is for {readings} and {pads}; give the calibration of this skin"
        )


def _check_rest(settings: LiveSettings) -> None:
    if settings.seconds is not None and settings.rest >= settings.seconds:
        raise LiveError(
            f"live: the rest levels take {settings.rest:g} s (--rest), and live ends after {settings.seconds:g} s "
            "(--seconds): nothing would be shown; give a longer --seconds or a shorter --rest"
        )


def _follower(
    calibration: Calibration, track: bool | je.tracking.TrackerSettings, warn: Callable[[str], object]
) -> LiveFollower:
    """What follows contacts, with the usual settings or with these."""
    settings = track if isinstance(track, je.tracking.TrackerSettings) else je.tracking.TrackerSettings()
    prepare = partial(prepare_calibrated_tracker, settings=settings, tell=warn)
    return LiveFollower(calibration, prepare, settings.most)


def _check_log(calibration: LogCalibration, sources: Sequence[Source], settings: LiveSettings) -> None:
    channels = sources[0].plan.channels
    if channels != calibration.columns:
        raise LiveError(
            f"live: {channels} channels, but this calibration is for {calibration.columns}; give the calibration of "
            "this sensor"
        )
    if calibration.needs_place and len(sources) < 2:
        raise LiveError("live: the calibration depends on the place of contact; give --stage, the URL of the stage")
    if isinstance(settings.proposal, je.contacts.Proposal):
        raise LiveError("live: --proposal: the calibration of a log has no EIT, which tells what touches the skin")
    if settings.track:
        raise LiveError("live: --track: the calibration of a log has no EIT, which tells where contacts are")
    if settings.recalibrate or settings.event_driven:
        raise LiveError(
            "live: --recalibrate and --event-driven need a skin with EIT; move this calibration by `jaxeit "
            "recalibrate`, from a log with force"
        )


def _process_frames(
    engine: Engine | LogEngine,
    queue: FrameQueue,
    recorder: Recorder,
    viewers: Sequence[Publish],
    control: LiveControl,
    settings: LiveSettings,
    director: ScanDirector | None,
) -> int:
    count, begun, until = 0, False, time.monotonic() + settings.wait
    while not (control.stop.is_set() or recorder.stop.is_set() or recorder.ended):
        _tell_faults(control, engine, recorder)
        if _must_tare(engine, control):
            engine.tare()
            if director is not None:
                director.request_all()
        arrival = queue.take(0.1)
        if arrival is None:
            if not begun and time.monotonic() > until:
                raise LiveError("; ".join(map(explain_silence, recorder.silent_receivers)))
            if begun and time.monotonic() > until:
                break
            continue
        if not begun:
            begun, until = True, time.monotonic() + (np.inf if settings.seconds is None else settings.seconds)
        result = _step(engine, arrival, queue.dropped)
        _tell_state(control, engine, recorder)
        if result is not None:
            count += 1
            for publish in viewers:
                publish(result)
            if director is not None:
                director.update(cast(Engine, engine).pressed(arrival), cast(FrameResult, result).centre)
            engine.use_spare_time(queue.time_to_next())
        if time.monotonic() > until:
            break
    return count


def _step(engine: Engine | LogEngine, arrival: ReceivedFrame, dropped: int) -> Result | None:
    """Process one frame."""
    try:
        return engine.step(arrival, dropped)
    except NotFollowed as error:
        raise LiveError(f"live: --track: {error}; measure the untouched skin for longer: --rest") from error


def _must_tare(engine: Engine | LogEngine, control: LiveControl) -> bool:
    """Whether the rest levels are to be measured again: on request, or because they must be wrong."""
    wrong = engine.has_wrong_zero(time.monotonic_ns())
    if wrong:
        control.warn("pads read below zero: the skin was pressed when zero was measured, which is done again now")
    if control.tare.is_set():
        control.tare.clear()
        return True
    return wrong


def _tell_state(control: LiveControl, engine: Engine | LogEngine, recorder: Recorder) -> None:
    """Show viewers the state of engine and streams, and warn the operator of a skin that is not at rest."""
    control.lost = sum(receiver.counters.lost for receiver in recorder.receivers)
    control.simulated = any(receiver.counters.simulated for receiver in recorder.receivers)
    if engine.state != control.state and engine.restless:
        control.warn(engine.state)
    if engine.doubt not in ("", control.doubt):
        control.warn(engine.doubt)
    control.state, control.health, control.doubt = engine.state, engine.health, engine.doubt
    control.layer = engine.layer


def _tell_faults(control: LiveControl, engine: Engine | LogEngine, recorder: Recorder) -> None:
    """Show viewers what is wrong with the streams and their links, and warn the operator once of each."""
    faults = (*engine.faults, *filter(None, map(explain_reopening, recorder.receivers)))
    for fault in faults:
        if fault not in control.faults:
            control.warn(fault)
    control.faults = faults
