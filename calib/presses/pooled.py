"""Pool the presses of several sessions into one table, to which curves and fields are fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

import jaxeit as je

from ..session import Session
from .corrections import correct
from .crosstalk import Crosstalk, fit_crosstalk
from .means import FILTER_MARGIN, dominant_pad
from .streams import finite_mean, index_ranges
from .table import PressMeasurements, Processing, measure

# Least share of a press that a pad must carry for the press to determine the pad's curve and field.
MIN_SHARE = 1 / 3
# Fraction of the largest fitted pressure below which the force of a curve that is not zero at rest falls to zero.
REST_FRACTION = 0.05
MEANS_PER_PRESS = 24  # that replace the samples of a press, because neighbouring samples are nearly equal


class PressSeries(NamedTuple):
    """Samples along all presses, in order of time.

    | field    | meaning                              | shape     | unit |
    |----------|--------------------------------------|-----------|------|
    | press    | row of the sample's press            | (n,)      |      |
    | pressure | change of the pads' pressures        | (n, pads) | Pa   |
    | force    | from the load cell                   | (n,)      | N    |
    """

    press: np.ndarray
    pressure: np.ndarray
    force: np.ndarray


class HoldSeries(NamedTuple):
    """Samples along all presses and the means over their holds as one series, for curves with memory.

    | field    | meaning                              | shape               | unit |
    |----------|--------------------------------------|---------------------|------|
    | pressure | change of the pads' pressures        | (n + presses, pads) | Pa   |
    | press    | row of the press                     | (n + presses,)      |      |
    | hold     | row in this series of each hold      | (presses,)          |      |
    """

    pressure: np.ndarray
    press: np.ndarray
    hold: np.ndarray


class PadSamples(NamedTuple):
    """Samples to which the curve of each pad is fitted, in order of time; padding is not in `mask`.

    | field    | meaning                          | shape     | unit |
    |----------|----------------------------------|-----------|------|
    | rows     | of the samples in `PressData`    | (pads, m) |      |
    | pressure | of the pad                       | (pads, m) | Pa   |
    | force    |                                  | (pads, m) | N    |
    | mask     | samples to be fitted             | (pads, m) |      |
    | place    | number of the place pressed      | (pads, m) |      |
    """

    rows: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    mask: np.ndarray
    place: np.ndarray


@dataclass(frozen=True, eq=False)
class PressData:
    """Presses of one or more sessions: their samples, and the means over their holds. Pressures are the pads' own.

    | field           | meaning                                                      | shape           | unit |
    |-----------------|--------------------------------------------------------------|-----------------|------|
    | sample_pressure | of pads, along presses                                       | (pads, n)       | Pa   |
    | sample_force    | force of the load cell along the presses                     | (n,)            | N    |
    | sample_press    | row of the sample's press                                    | (n,)            |      |
    | mask            | samples from which a pad's curve is fitted                   | (pads, n)       |      |
    | pressure        | of the pads over the hold                                    | (presses, pads) | Pa   |
    | force           | force of the load cell over the hold                         | (presses,)      | N    |
    | place           | number of the place pressed                                  | (presses,)      |      |
    | reach           | lowest and highest corner of the box of places               | (2, 2)          | m    |
    """

    sample_pressure: np.ndarray
    sample_force: np.ndarray
    sample_press: np.ndarray
    mask: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    place: np.ndarray
    reach: np.ndarray

    @cached_property
    def share(self) -> np.ndarray:
        """Share of each pad in the positive pressure over the hold, (presses, pads): where pads are alike, in force."""
        positive = np.maximum(np.nan_to_num(self.pressure), 0)
        total = positive.sum(1, keepdims=True)
        return np.asarray(positive / np.where(total > 0, total, 1))

    @property
    def sample_place(self) -> np.ndarray:
        """Number of the place of each sample, (n,)."""
        return np.asarray(self.place[self.sample_press])

    @cached_property
    def rest_forces(self) -> np.ndarray:
        """Force (pads, n) N on pads at rest, a straight line; NaN above `REST_FRACTION` of the largest fitted pressure.

        The line goes through the mean of the fitted samples.
        """
        fitted = np.where(self.mask, self.sample_pressure, 0)
        force = np.where(self.mask, self.sample_force * self.share[self.sample_press].T, 0).sum(1)
        total = fitted.sum(1)
        slope = np.where(total > 0, force / np.where(total > 0, total, 1), 0)
        at_rest = self.sample_pressure < REST_FRACTION * fitted.max(1, initial=0)[:, None]
        return np.asarray(np.where(at_rest, slope[:, None] * self.sample_pressure, np.nan))

    @cached_property
    def with_holds(self) -> HoldSeries:
        """The samples, and the means over the holds where they follow the samples before them."""
        return with_holds(PressSeries(self.sample_press, self.sample_pressure.T, self.sample_force), self.pressure)

    def pad_samples(self, *, with_history: bool) -> PadSamples:
        """Samples of each pad; all samples ``with_history``, for a curve that depends on earlier pressures."""
        all_rows = np.broadcast_to(np.arange(len(self.sample_force)), self.mask.shape)
        rows = all_rows if with_history else self._fit_rows
        pressure, mask = (np.take_along_axis(a, rows, 1) for a in (self.sample_pressure, self.mask))
        return PadSamples(rows, pressure, self.sample_force[rows], mask, self.sample_place[rows])

    @cached_property
    def _fit_rows(self) -> np.ndarray:
        """Rows (pads, m) of each pad's samples in `mask`, of missing samples, and of padding, in order of time."""
        relevant = self.mask | ~(np.isfinite(self.sample_pressure) & np.isfinite(self.sample_force))
        most = relevant.sum(1).max(initial=0)
        return np.argsort(~relevant, axis=1, kind="stable")[:, :most]


@dataclass(frozen=True, eq=False)
class PooledPresses:
    """Presses of several sessions, concatenated in the order of the sessions.

    | field      | meaning                                                    | shape               | unit |
    |------------|------------------------------------------------------------|---------------------|------|
    | recordings | measurements of each session                               |                     |      |
    | series     | all samples along the presses                              |                     |      |
    | data       | samples and means to which curves and fields are fitted    |                     |      |
    | dv         | change of the readings over the hold                       | (presses, readings) | V    |
    | position   | true position of the tip                                   | (presses, 2)        | m    |
    | owner      | pad that carries the press alone, -1 without one           | (presses,)          |      |
    | groups     | number of the pad, indenter and session of each press      | (presses,) each     |      |
    | channels   | whether a reading was finite in every press                | (readings,)         |      |
    | noise      | of a frame: the largest of the sessions                    | (readings,)         | V    |
    | crosstalk  | between the pads; all pressures are the pads' own          |                     |      |
    | untouched  | readings without contact                                   | (readings,)         | V    |
    | true_place | whether the position comes from a simulation, and is exact |                     |      |
    | notes      | remarks for the operator, by session                       |                     |      |
    """

    recordings: tuple[PressMeasurements, ...]
    series: PressSeries
    data: PressData
    dv: np.ndarray
    position: np.ndarray
    owner: np.ndarray
    groups: Mapping[str, np.ndarray]
    channels: np.ndarray
    noise: np.ndarray
    crosstalk: Crosstalk
    untouched: np.ndarray
    true_place: bool
    notes: tuple[str, ...]

    def quiet_frames(self, processing: Processing) -> np.ndarray:
        """Frames (n, readings) V before the presses, minus the mean of each rest; the noise is estimated from them."""
        return np.concatenate([np.concatenate(_rest_residuals(one, "eit", processing)) for one in self.recordings])

    @property
    def sensor_noise(self) -> np.ndarray:
        """Standard deviation of single readings of the pads at rest, (pads,) Pa, the median of rests; 0 without any.

        Of readings as a live view takes them, without the low-pass by which recordings are corrected. A pad that
        recovers from a press moves during the rest after it, which makes the deviation of that rest larger.
        """
        rests = [rest for one in self.recordings for rest in _rest_residuals(one, "pressure") if len(rest)]
        if not rests:
            return np.zeros(self.data.pressure.shape[1])
        deviations = np.array([np.sqrt(finite_mean(rest**2)) for rest in rests])
        return np.asarray(np.nanmedian(np.where(np.isfinite(deviations).any(0), deviations, 0.0), 0))


def pool_presses(sessions: Sequence[Session], skin: je.Skin, processing: Processing | None = None) -> PooledPresses:
    """Cut the presses out of all sessions and concatenate them.

    Raises:
        SessionError: if a session was not recorded on this skin, lacks a stream, or holds no press that can be used.
    """
    recordings = tuple(measure(session, skin, processing) for session in sessions)
    position = np.concatenate([m.position for m in recordings])
    pressure = np.concatenate([m.pressure for m in recordings])
    crosstalk = fit_crosstalk(pressure, position, skin.pads)
    pressure = crosstalk.own(pressure)
    owner = dominant_pad(pressure)
    readings = press_series(recordings)
    series = readings._replace(pressure=crosstalk.own(readings.pressure))
    tip = np.concatenate([m.presses.tip_diameter[m.presses.accepted] for m in recordings])
    return PooledPresses(
        recordings=recordings,
        series=series,
        data=_press_data(recordings, position, pressure, block_means(series, MEANS_PER_PRESS)),
        dv=np.concatenate([m.dv for m in recordings]),
        position=position,
        owner=owner,
        groups={
            "pad": owner,
            "indenter": np.unique(np.round(tip, 6), return_inverse=True)[1].ravel(),
            "session": np.repeat(np.arange(len(recordings)), [len(m.force) for m in recordings]),
        },
        channels=np.logical_and.reduce([m.channels for m in recordings]),
        noise=np.max([m.noise for m in recordings], 0),
        crosstalk=crosstalk,
        untouched=np.mean([m.untouched for m in recordings], 0),
        true_place=any("contact_position" in m.session.truth for m in recordings),
        notes=tuple(f"{m.session.name}: {note}" for m in recordings for note in m.notes),
    )


def _press_data(
    recordings: Sequence[PressMeasurements], position: np.ndarray, pressure: np.ndarray, means: PressSeries
) -> PressData:
    finite = np.isfinite(means.pressure).all(1) & np.isfinite(means.force)
    data = PressData(
        sample_pressure=means.pressure.T,
        sample_force=means.force,
        sample_press=means.press,
        mask=np.broadcast_to(finite, means.pressure.T.shape),
        pressure=pressure,
        force=np.concatenate([m.force for m in recordings]),
        place=np.unique(np.round(position, 6), axis=0, return_inverse=True)[1].ravel(),
        reach=np.stack([position.min(0), position.max(0)]),
    )
    return replace(data, mask=data.mask & (data.share[means.press] >= MIN_SHARE).T)


def press_series(recordings: Sequence[PressMeasurements]) -> PressSeries:
    """Readings of the pads and forces along all accepted presses; pressures with crosstalk."""
    return PressSeries(
        _sample_presses(recordings),
        np.concatenate([m.samples.pressure for m in recordings]),
        np.concatenate([m.samples.force for m in recordings]),
    )


def _sample_presses(recordings: Sequence[PressMeasurements]) -> np.ndarray:
    """Row (n,) of the press of each sample, among all accepted presses."""
    rows, first = [], 0
    for m in recordings:
        number = np.cumsum(m.presses.accepted) - 1
        rows.append(first + number[m.samples.press])
        first += len(m.force)
    return np.concatenate(rows)


def with_holds(series: PressSeries, pressure: np.ndarray) -> HoldSeries:
    """The samples along presses, with the mean over each hold (presses, pads) Pa after the largest pressure before it.

    A curve with memory depends on the pressures before a hold: all presses before it, and the way up to it.
    """
    number = np.arange(len(pressure))
    first, last = (np.searchsorted(series.press, number, side) for side in ("left", "right"))
    total = np.nan_to_num(series.pressure).sum(1)
    rows = np.array([a + 1 + np.argmax(total[a:b]) if b > a else a for a, b in zip(first, last, strict=True)], int)
    return HoldSeries(
        np.insert(series.pressure, rows, pressure, axis=0), np.insert(series.press, rows, number), rows + number
    )


def block_means(series: PressSeries, most: int) -> PressSeries:
    """Replace the samples of each press by at most `most` means over equal parts of it, in order of time.

    A part with a missing sample has no mean (NaN).
    """
    press, pressure, force = series
    if not len(press):
        return series
    starts = np.flatnonzero(np.r_[True, press[1:] != press[:-1]])
    ends = np.append(starts[1:], len(press))
    cuts = [np.linspace(a, b, min(most, b - a) + 1).astype(int)[:-1] for a, b in zip(starts, ends, strict=True)]
    first = np.concatenate(cuts).astype(int)
    count = np.diff(np.append(first, len(press)))
    return PressSeries(
        press[first], np.add.reduceat(pressure, first) / count[:, None], np.add.reduceat(force, first) / count
    )


def _rest_residuals(recording: PressMeasurements, name: str, processing: Processing | None = None) -> list[np.ndarray]:
    """Samples of a stream in the rests before the accepted presses, minus the mean of each rest.

    Subtracting the mean of n samples removes one degree of freedom; the factor sqrt(n / (n - 1)) restores the variance.
    The first rest is empty. Samples are corrected by the ``processing``; default: not at all.
    """
    stream, windows = recording.session.stream(name), recording.windows.rest_before[recording.presses.accepted]
    corrections = () if processing is None else processing.of(stream)
    rests = [np.empty((0, stream.channels))]
    for window in windows:
        first, last = index_ranges(stream.time, window + np.array([-FILTER_MARGIN, FILTER_MARGIN]))
        time = stream.time[first:last]
        frames = correct(corrections, time, stream.read(int(first), int(last)), stream.name)
        frames = frames[(time >= window[0]) & (time < window[1])]
        if len(frames) > 1:
            rests.append((frames - finite_mean(frames)) * np.sqrt(len(frames) / (len(frames) - 1)))
    return rests
