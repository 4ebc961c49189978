"""Measure the presses of a session: position, change of the readings, pad pressures and force of each press."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

import jaxeit as je
from jaxeit.messages.kinds import require_kind

from ..session import PressTable, Session, SessionError, Stream
from ..session.mixing import same_scan
from ..session.units import SECOND
from .corrections import (
    AbstractBaseline,
    AbstractCorrection,
    CorrectionError,
    LowPass,
    TwoSided,
    WindowMeans,
    sample_rate,
)
from .means import PressMeans, hold_positions, press_means
from .samples import PressSamples, press_samples
from .skins import rests_on_pads
from .streams import finite_mean, index_ranges, recording_end
from .timing.detection import find_presses
from .timing.times import reject
from .timing.windows import PressWindows, WindowLengths, press_windows, reject_without_samples

DEFAULT_CUTOFF = 50.0  # Hz, the low-pass of the paper


@dataclass(frozen=True)
class Processing:
    """How the presses of a session are cut out and corrected before a fit.

    | field       | meaning                                                                    | default         |
    |-------------|----------------------------------------------------------------------------|-----------------|
    | corrections | applied to every stream; None: a 50 Hz low-pass on the streams that are    | None            |
    |             | sampled fast enough, and a note for the others                             |                 |
    | baseline    | rule for what is subtracted from a press                                   | `TwoSided`      |
    | windows     | lengths of the windows                                                     | `WindowLengths` |

    Raises:
        CorrectionError: for another object in the place of one of these.
    """

    corrections: tuple[AbstractCorrection, ...] | None = None
    baseline: AbstractBaseline = field(default_factory=TwoSided)
    windows: WindowLengths = field(default_factory=WindowLengths)

    def __post_init__(self) -> None:
        if self.corrections is not None:
            give = "a tuple of corrections, such as (calib.presses.LowPass(50.0),)"
            require_kind(self.corrections, tuple, CorrectionError, "a tuple", give, "corrections")
            for one in self.corrections:
                require_kind(one, AbstractCorrection, CorrectionError, "a correction", give, "corrections")
        give = "one, such as calib.presses.TwoSided()"
        require_kind(self.baseline, AbstractBaseline, CorrectionError, "a baseline", give, "baseline")
        give = "calib.presses.WindowLengths()"
        require_kind(self.windows, WindowLengths, CorrectionError, "lengths of windows", give, "windows")

    def of(self, stream: Stream) -> tuple[AbstractCorrection, ...]:
        """Corrections for one stream."""
        if self.corrections is not None:
            return self.corrections
        return (LowPass(DEFAULT_CUTOFF),) if sample_rate(stream.time) > 2 * DEFAULT_CUTOFF else ()

    def notes(self, streams: Iterable[Stream]) -> tuple[str, ...]:
        """A note on the streams that the default correction does not apply to."""
        slow = [f"{each.name} ({sample_rate(each.time):.3g} Hz)" for each in streams if not self.of(each)]
        if self.corrections is not None or not slow:
            return ()
        return (f"no {DEFAULT_CUTOFF:g} Hz low-pass on {', '.join(slow)}: slow samples hold no higher frequencies",)


@dataclass(frozen=True, eq=False)
class PressMeasurements:
    """Measurements of one session, press by press. Rows are the presses that can be used.

    | field     | meaning                                                       | shape               | unit |
    |-----------|---------------------------------------------------------------|---------------------|------|
    | position  | true position of the tip                                      | (presses, 2)        | m    |
    | dv        | change of the readings over the hold                          | (presses, readings) | V    |
    | pressure  | change of the gage pressure of the pads over the hold         | (presses, pads)     | Pa   |
    | force     | force of the load cell over the hold                          | (presses,)          | N    |
    | untouched | readings without contact, mean over the presses               | (readings,)         | V    |
    | rest      | gage pressure of the pads without contact, at each press      | (presses, pads)     | Pa   |
    | noise     | standard deviation of the readings of a single frame          | (readings,)         | V    |
    | channels  | whether a reading was finite in every press                   | (readings,)         |      |
    | samples   | pressure and force over whole presses, sample by sample       |                     |      |
    | presses   | all presses, with the reasons of those that were set aside    |                     |      |
    | windows   | windows of all presses                                        |                     |      |
    | notes     | remarks for the operator                                      |                     |      |
    """

    session: Session
    position: np.ndarray
    dv: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    untouched: np.ndarray
    rest: np.ndarray
    noise: np.ndarray
    channels: np.ndarray
    samples: PressSamples
    presses: PressTable
    windows: PressWindows
    notes: tuple[str, ...]

    @property
    def noise_of_means(self) -> np.ndarray:
        """Standard deviation of a reading averaged over a hold of median length, (readings,) V."""
        held = index_ranges(self.session.stream("eit").time, self.windows.hold[self.presses.accepted])
        return np.asarray(self.noise / np.sqrt(np.median(np.diff(held))))


def measure(
    session: Session, skin: je.Skin, processing: Processing | None = None, *, place_needed: bool = True
) -> PressMeasurements:
    """Cut the presses out of the streams of a session, correct them and average each over its hold.

    Args:
        session: with eit, pressure and force streams; a stage stream if it has no table of presses.
        skin: the skin that the session was recorded on.
        processing: `Processing()` by default.
        place_needed: whether the session must tell where the presses were; otherwise positions may be NaN.

    Raises:
        SessionError: if the session was not recorded on this skin, lacks a stream, or no press can be used.
    """
    processing = processing or Processing()
    streams = {name: session.stream(name) for name in ("eit", "pressure", "force")}
    require_skin(session, skin, streams)
    presses = _press_table(session, streams["force"], place_needed)
    windows = press_windows(presses, processing.windows, recording_end(streams.values()))
    presses = reject_without_samples(presses, windows, streams.values(), processing.baseline)
    stream_means = _hold_means(streams, windows, processing)
    means = {name: result.change.mean for name, result in stream_means.items()}
    channels, lost = _finite_channels(means["eit"], presses.accepted)
    _require_pads(session, skin, means["pressure"][presses.accepted])
    force = means["force"][:, 0]
    presses = _reject_without_force(session, _reject_off_pads(presses, skin), force, means["pressure"])
    kept = presses.accepted
    return PressMeasurements(
        session=session,
        position=np.stack([presses.x, presses.y], 1)[kept],
        dv=means["eit"][kept],
        pressure=means["pressure"][kept],
        force=force[kept],
        untouched=stream_means["eit"].baseline[kept].mean(0),
        rest=stream_means["pressure"].baseline[kept],
        noise=_frame_noise(stream_means["eit"].change, kept),
        channels=channels,
        samples=_samples(streams, presses, windows, processing),
        presses=presses,
        windows=windows,
        notes=(*processing.notes(streams.values()), *lost, *_rejection_notes(presses)),
    )


def _error(session: Session, where: str, what: str, todo: str) -> SessionError:
    return SessionError(f"{session.name}: {where}: {what}; {todo}")


def require_skin(session: Session, skin: je.Skin, streams: dict[str, Stream]) -> None:
    """Check that eit and pressure streams are those of the skin; raises SessionError otherwise."""
    for name, stream in streams.items():
        if not len(stream):
            raise _error(session, f"/streams/{name}", "holds no sample", "record again")
    if session.pattern is None:
        raise _error(session, "/device", "has no eit_protocol", "record the pattern of the scan")
    if not same_scan(session, skin.protocol):
        recorded = f"the skin that was recorded, {session.skin_name!r}" if session.skin_name else "the recorded skin"
        todo = f"take a calibration of {recorded}, or calibrate with it (--skin FILE)"
        raise _error(session, "/device/eit_protocol/pattern", f"is not that of the skin {skin.name!r}", todo)
    pads = streams["pressure"].channels
    if pads != len(skin.pads):
        raise _error(
            session,
            "/streams/pressure",
            f"has {pads} columns, the skin {skin.name!r} has {len(skin.pads)} pads",
            "record every pad, or describe the skin as it is in its TOML file",
        )


def _press_table(session: Session, force: Stream, place_needed: bool) -> PressTable:
    if session.presses is not None and len(session.presses):
        return session.presses
    if "stage" not in session.streams and place_needed:
        raise _error(
            session,
            "/presses",
            "no table of presses, and no stage stream that tells where presses were",
            "record the stage, or write the table",
        )
    found = find_presses(force.time, force.read()[:, 0])
    count = len(found)
    staged = "stage" in session.streams
    place = hold_positions(found, session.streams["stage"]) if staged else np.full((count, 2), np.nan)
    return PressTable(
        x=place[:, 0],
        y=place[:, 1],
        tip_diameter=np.zeros(count),
        target_force=np.zeros(count),
        t_press=found.t_press,
        t_hold0=found.t_hold0,
        t_hold1=found.t_hold1,
        t_release=found.t_release,
        pad=np.full(count, -1),
        accepted=found.accepted,
        reason=found.reason,
    )


def _finite_channels(dv: np.ndarray, accepted: np.ndarray) -> tuple[np.ndarray, list[str]]:
    good = np.isfinite(dv[accepted]).all(0)
    lost = np.flatnonzero(~good)
    if not len(lost):
        return good, []
    some = ", ".join(map(str, lost[:8])) + (", ..." if len(lost) > 8 else "")
    return good, [f"eit channels without a finite value in every press, left out: {some}"]


def _frame_noise(change: WindowMeans, kept: np.ndarray) -> np.ndarray:
    """Noise of one frame from the standard errors of the hold means; a channel without one gets the median."""
    each = (change.standard_error * np.sqrt(change.count))[kept]
    good = np.isfinite(each) & (each > 0)
    overall = np.median(each[good]) if good.any() else np.nanmax(np.abs(change.mean[kept])) * 1e-6
    noise = np.array([np.median(e[g]) if g.any() else overall for e, g in zip(each.T, good.T, strict=True)])
    return np.asarray(np.maximum(noise, 0.1 * overall))


def _require_pads(session: Session, skin: je.Skin, pressure: np.ndarray) -> None:
    silent = ~np.isfinite(pressure).any(0)
    if len(pressure) and silent.any():
        number = int(np.argmax(silent))
        raise _error(
            session,
            "/streams/pressure",
            f"column {number}, pad {skin.pads[number].name!r}, holds no finite sample",
            "repair its sensor and record again, or remove the pad from the skin's file",
        )


def _hold_means(streams: dict[str, Stream], windows: PressWindows, processing: Processing) -> dict[str, PressMeans]:
    """Means of each stream over the holds of the presses, corrected."""
    return {
        name: press_means(stream, windows, baseline=processing.baseline, corrections=processing.of(stream))
        for name, stream in streams.items()
    }


def _reject_off_pads(presses: PressTable, skin: je.Skin) -> PressTable:
    """Reject presses beside all pads, whose force no pad measures."""
    on_pads = rests_on_pads(skin, np.stack([presses.x, presses.y], 1), presses.tip_diameter)
    return reject(presses, ["" if on else "it rests on no pad" for on in on_pads])


def _reject_without_force(session: Session, presses: PressTable, force: np.ndarray, pressure: np.ndarray) -> PressTable:
    """Reject presses without force (presses,) or pressure; raises SessionError if none is left."""
    finite = np.isfinite(force) & np.isfinite(pressure).all(1)
    reasons = [
        "" if ok and f > 0 else ("no force" if ok else "force or pressure missing in the hold")
        for ok, f in zip(finite, force, strict=True)
    ]
    presses = reject(presses, reasons)
    if not presses.accepted.any():
        raise _error(session, "/presses", _rejection_summary(presses), "see jaxeit check")
    return presses


def _samples(
    streams: dict[str, Stream], presses: PressTable, windows: PressWindows, processing: Processing
) -> PressSamples:
    """Pressure and force over whole presses; those of the force correct both."""
    force, pressure, corrections = streams["force"], streams["pressure"], processing.of(streams["force"])
    return press_samples(force, pressure, presses, windows, baseline=processing.baseline, corrections=corrections)


def _rejection_summary(presses: PressTable) -> str:
    if not len(presses):
        return "no press is listed or found in the force"
    reasons = sorted({r for r in presses.reason if r})
    return f"none of {len(presses)} presses can be used" + (f": {reasons[0]}" if reasons else "")


def _rejection_notes(presses: PressTable) -> list[str]:
    bad = np.flatnonzero(~presses.accepted)
    if not len(bad):
        return []
    first = f"press {bad[0]}: {presses.reason[bad[0]]}"
    return [f"{len(bad)} of {len(presses)} presses set aside ({first})"]


Level = Callable[[np.ndarray], np.ndarray]
"""Values of channels without contact as a function of time: (n,) ns -> (n, channels)."""


def resting_levels(session: Session, skin: je.Skin, processing: Processing) -> dict[str, Level]:
    """Level without contact of the eit and pressure streams, as functions of time: (n,) ns -> (n, channels).

    A level is linear between the means of the rest windows around the presses and constant outside them.
    In a session without a table of presses it is the mean of the first second.

    Raises:
        SessionError: if the session was not recorded on this skin, or a stream is missing.
    """
    streams = {name: session.stream(name) for name in ("eit", "pressure")}
    require_skin(session, skin, streams)
    return {name: _level(stream, _rest_windows(session, stream, processing)) for name, stream in streams.items()}


def _rest_windows(session: Session, stream: Stream, processing: Processing) -> np.ndarray:
    """Rest windows (rests, 2) in ns, in order of time, that hold at least one sample of the stream."""
    table = session.presses
    if table is None or not len(table):
        start = int(stream.time[0])
        return np.array([[start, start + SECOND]])
    windows = press_windows(table, processing.windows, recording_end([stream]))
    both = np.concatenate([windows.rest_before, windows.rest_after])
    both = both[np.argsort(both[:, 0], kind="stable")]
    ranges = index_ranges(stream.time, both)
    return both[ranges[:, 1] > ranges[:, 0]]


def _level(stream: Stream, rests: np.ndarray) -> Level:
    means = np.array([finite_mean(stream.read(int(a), int(b))) for a, b in index_ranges(stream.time, rests)])
    centres = rests.astype(float).mean(1)

    def level(time: np.ndarray) -> np.ndarray:
        right = np.clip(np.searchsorted(centres, time), 1, max(len(centres) - 1, 1))
        left = right - 1
        right = np.minimum(right, len(centres) - 1)
        step = np.where(right > left, centres[right] - centres[left], 1.0)
        share = np.clip((time - centres[left]) / step, 0.0, 1.0)[:, None]
        return np.asarray((1 - share) * means[left] + share * means[right])

    return level
