"""What a session says about each press, in the terms that a calibration needs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

import jaxeit as je

from .corrections import AbstractBaseline, AbstractCorrection, Estimate, LowPass, TwoSided, sample_rate
from .presses import (
    Cutting,
    PressSamples,
    Windows,
    check_overlap,
    find_presses,
    index_ranges,
    locate,
    press_means,
    press_samples,
    press_windows,
    recording_end,
    reject,
)
from .session import PressTable, Session, SessionError, Stream

_LOW_PASS = 50.0  # Hz, the paper's


@dataclass(frozen=True)
class Processing:
    """How a session is cut and corrected before anything is fitted.

    | meaning                                                                           | default    |
    |-----------------------------------------------------------------------------------|------------|
    | corrections: applied to every stream; None: the paper's 50 Hz low-pass on those    | None       |
    |   streams that are sampled fast enough for it, the others noted                    |            |
    | baseline: what is taken off a press                                                | `TwoSided` |
    | cutting: lengths of the windows                                                    | `Cutting`  |
    """

    corrections: tuple[AbstractCorrection, ...] | None = None
    baseline: AbstractBaseline = field(default_factory=TwoSided)
    cutting: Cutting = field(default_factory=Cutting)

    def of(self, stream: Stream) -> tuple[tuple[AbstractCorrection, ...], str]:
        """The corrections for one stream, and a note where the default one does not apply."""
        if self.corrections is not None:
            return self.corrections, ""
        rate = sample_rate(stream.time)
        if rate > 2 * _LOW_PASS:
            return (LowPass(_LOW_PASS),), ""
        return (), (
            f"{stream.name} is recorded at {rate:.3g} Hz: the {_LOW_PASS:g} Hz low-pass has nothing "
            "to remove and is left out"
        )


@dataclass(frozen=True, eq=False)
class Measured:
    """One session, press by press; rows are the presses that can be used.

    | meaning                                                          | shape             | unit |
    |------------------------------------------------------------------|-------------------|------|
    | position of the tip, true                                        | (presses, 2)      | m    |
    | dv: change of the readings over the hold                         | (presses, readings)| V   |
    | pressure: change of the pads' gage pressure over the hold        | (presses, pads)   | Pa   |
    | force over the hold, from the load cell                          | (presses,)        | N    |
    | untouched: readings without contact, mean over the presses       | (readings,)       | V    |
    | noise: standard deviation of a single frame, at rest or held     | (readings,)       | V    |
    | channels: readings that were finite in every press               | (readings,)       |      |
    | samples: pressure and force all along the presses                |                   |      |
    | presses: all of them, with the reasons of those set aside        |                   |      |
    | windows of all of them                                           |                   |      |
    | notes: what a person should know                                 |                   |      |
    """

    session: Session
    position: np.ndarray
    dv: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    untouched: np.ndarray
    noise: np.ndarray
    channels: np.ndarray
    samples: PressSamples
    presses: PressTable
    windows: Windows
    notes: tuple[str, ...]


def measure(session: Session, skin: je.Skin, processing: Processing | None = None) -> Measured:
    """Cut the presses out of a session's streams, on one clock, with noise and baseline removed.

    Raises:
        SessionError: if the session was not recorded on this skin, lacks a stream, or no press can
            be used.
    """
    processing = processing or Processing()
    streams = {name: session.stream(name) for name in ("eit", "pressure", "force")}
    _require_skin(session, skin, streams)
    presses = _presses(session, streams["force"])
    windows = press_windows(presses, processing.cutting, recording_end(streams.values()))
    presses = check_overlap(presses, windows, streams.values(), processing.baseline)
    chosen = {name: processing.of(stream) for name, stream in streams.items()}
    held = {
        name: press_means(stream, windows, baseline=processing.baseline, corrections=chosen[name][0])
        for name, stream in streams.items()
    }
    means = {name: found.change.mean for name, found in held.items()}
    channels, lost = _finite_channels(means["eit"], presses.accepted)
    _require_pads(session, skin, means["pressure"][presses.accepted])
    force = means["force"][:, 0]
    presses = reject(presses, _without_force(force, means["pressure"]))
    kept = presses.accepted
    if not kept.any():
        raise _error(session, "/presses", _why_none(presses), "see jaxeit check")
    samples = press_samples(
        streams["force"],
        streams["pressure"],
        presses,
        windows,
        baseline=processing.baseline,
        corrections=chosen["force"][0],
    )
    position = np.stack([presses.x, presses.y], 1)[kept]
    notes = [note for _, note in chosen.values() if note]
    return Measured(
        session=session,
        position=position,
        dv=means["eit"][kept],
        pressure=means["pressure"][kept],
        force=force[kept],
        untouched=held["eit"].baseline[kept].mean(0),
        noise=_frame_noise(held["eit"].change, kept),
        channels=channels,
        samples=samples,
        presses=presses,
        windows=windows,
        notes=(*notes, *lost, *_set_aside(presses)),
    )


def _error(session: Session, where: str, what: str, todo: str) -> SessionError:
    return SessionError(f"{session.name}: {where}: {what}; {todo}")


def _require_skin(session: Session, skin: je.Skin, streams: dict[str, Stream]) -> None:
    pattern = session.pattern
    if pattern is None:
        raise _error(session, "/device", "has no eit_protocol", "record the pattern of the scan")
    if pattern.shape != skin.protocol.pattern.shape or (pattern != skin.protocol.pattern).any():
        raise _error(
            session,
            "/device/eit_protocol/pattern",
            f"is not that of the skin {skin.name!r}",
            "calibrate with the skin that was recorded (--skin FILE)",
        )
    pads = streams["pressure"].channels
    if pads != len(skin.pads):
        raise _error(
            session,
            "/streams/pressure",
            f"has {pads} columns, the skin {skin.name!r} has {len(skin.pads)} pads",
            "record every pad, or describe the skin as it is in its TOML file",
        )


def _presses(session: Session, force: Stream) -> PressTable:
    if session.presses is not None and len(session.presses):
        return session.presses
    if "stage" not in session.streams:
        raise _error(
            session,
            "/presses",
            "no table of presses, and no stage stream to place them by",
            "record the stage, or write the table",
        )
    found = find_presses(force.time, force.read()[:, 0])
    place = locate(found, session.streams["stage"])
    count = len(found)
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


def _frame_noise(change: Estimate, kept: np.ndarray) -> np.ndarray:
    """Noise of one frame from the standard errors of the means over the holds; the median where a channel has none."""
    each = (change.standard_error * np.sqrt(change.count))[kept]
    good = np.isfinite(each) & (each > 0)
    overall = np.median(each[good]) if good.any() else np.nanmax(np.abs(change.mean[kept])) * 1e-6
    noise = np.array([np.median(e[g]) if g.any() else overall for e, g in zip(each.T, good.T, strict=True)])
    return np.maximum(noise, 0.1 * overall)


def _require_pads(session: Session, skin: je.Skin, pressure: np.ndarray) -> None:
    silent = ~np.isfinite(pressure).any(0)
    if len(pressure) and silent.any():
        number = int(np.argmax(silent))
        raise _error(
            session,
            "/streams/pressure",
            f"column {number}, pad {skin.pads[number].name!r}, holds no finite sample",
            "see to its sensor and record again, or take the pad out of the skin's file",
        )


def _without_force(force: np.ndarray, pressure: np.ndarray) -> Sequence[str]:
    finite = np.isfinite(force) & np.isfinite(pressure).all(1)
    return [
        "" if ok and f > 0 else ("no force" if ok else "force or pressure missing in the hold")
        for ok, f in zip(finite, force, strict=True)
    ]


def _why_none(presses: PressTable) -> str:
    reasons = sorted({r for r in presses.reason if r})
    return f"none of {len(presses)} presses can be used" + (f": {reasons[0]}" if reasons else "")


def _set_aside(presses: PressTable) -> list[str]:
    bad = np.flatnonzero(~presses.accepted)
    if not len(bad):
        return []
    first = f"press {bad[0]}: {presses.reason[bad[0]]}"
    return [f"{len(bad)} of {len(presses)} presses set aside ({first})"]


def resting_levels(
    session: Session, skin: je.Skin, processing: Processing
) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """For the eit and pressure streams, the level without contact at any time: times ns -> values.

    Straight lines between the means of the rest windows around the presses, constant outside them;
    where no presses are known, the mean of the first second.

    Raises:
        SessionError: if the session was not recorded on this skin, or a stream is missing.
    """
    streams = {name: session.stream(name) for name in ("eit", "pressure")}
    _require_skin(session, skin, streams)
    return {name: _level(stream, _rests(session, stream, processing)) for name, stream in streams.items()}


def _rests(session: Session, stream: Stream, processing: Processing) -> np.ndarray:
    """Rest windows in time, (rests, 2) ns."""
    table = session.presses
    if table is None or not len(table):
        start = int(stream.time[0])
        return np.array([[start, start + 1_000_000_000]])
    windows = press_windows(table, processing.cutting, recording_end([stream]))
    both = np.concatenate([windows.rest_before, windows.rest_after])
    both = both[np.argsort(both[:, 0], kind="stable")]
    ranges = index_ranges(stream.time, both)
    return both[ranges[:, 1] > ranges[:, 0]]


def _level(stream: Stream, rests: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    means = [_mean(stream, span) for span in index_ranges(stream.time, rests)]
    centres = rests.astype(float).mean(1)

    def level(time: np.ndarray) -> np.ndarray:
        right = np.clip(np.searchsorted(centres, time), 1, max(len(centres) - 1, 1))
        left = right - 1
        right = np.minimum(right, len(centres) - 1)
        step = np.where(right > left, centres[right] - centres[left], 1.0)
        share = np.clip((time - centres[left]) / step, 0.0, 1.0)[:, None]
        table = np.array(means)
        return (1 - share) * table[left] + share * table[right]

    return level


def _mean(stream: Stream, span: np.ndarray) -> np.ndarray:
    values = stream.read(int(span[0]), int(span[1]))
    count = np.isfinite(values).sum(0)
    total = np.where(np.isfinite(values), values, 0.0).sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
