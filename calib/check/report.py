"""The report of `jaxeit check`: findings, tables, and the report as JSON."""

import enum
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..presses.timing.onsets import OnsetDelay
from .eit.reading_order import OrderCheck


class Severity(enum.IntEnum):
    """Weight of a finding: OK is information, a WARNING should be looked at, an ERROR spoils a calibration."""

    OK = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True)
class Finding:
    """One statement about a recording: ``severity``, ``where`` it applies, ``what`` is the case, and ``remedy``.

    ``uninformative``: the channels, from 0, that carry no information; the calibration of a log leaves them out.
    """

    severity: Severity
    where: str
    what: str
    remedy: str = ""
    uninformative: tuple[int, ...] = ()


@dataclass(frozen=True)
class StreamRow:
    """Summary of one stream.

    | field              | meaning                                                                         | unit |
    |--------------------|---------------------------------------------------------------------------------|------|
    | nominal_rate, rate | stated rate; rate from the time stamps, NaN with fewer than two samples         | Hz   |
    | gaps, longest_gap  | number of intervals longer than one and a half periods; the longest of them     | s    |
    | dropped            | lost samples by sequence numbers; without these, estimated from the gaps        |      |
    | jitter             | 95 % quantile of the deviation of intervals from their median, without the gaps | s    |
    | missing            | fraction of all values                                                          |      |
    | flags              | number of samples by status flag                                                |      |
    """

    name: str
    variable: str
    unit: str
    channels: int
    samples: int
    seconds: float
    nominal_rate: float
    rate: float
    gaps: int
    longest_gap: float
    dropped: int
    jitter: float
    missing: float
    flags: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class PadRow:
    """Summary of one column of the pressure stream.

    | field      | meaning                                                 | unit |
    |------------|---------------------------------------------------------|------|
    | low, high  | extreme values                                          | Pa   |
    | missing    | fraction of the samples                                 |      |
    | full_scale | fraction of the samples at the upper end of the sensor  |      |
    | dead       | no value, or one and the same value in all samples      |      |
    """

    column: int
    name: str
    low: float
    high: float
    missing: float
    full_scale: float
    dead: bool


@dataclass(frozen=True, eq=False)
class ChannelTable:
    """EIT readings of the untouched skin; every array has one entry per reading.

    | field                  | meaning                                                                | unit |
    |------------------------|------------------------------------------------------------------------|------|
    | pattern                | drive+, drive-, sense+, sense- (rows, 4)                               |      |
    | mixing                 | readings as sums of rows, (readings, rows); None: each row is one      |      |
    | mean, noise            | over `frames` frames without contact                                   | V    |
    | snr                    | 20 log10(abs(mean) / noise)                                            | dB   |
    | partner                | row of the reciprocal reading, -1 without one                          |      |
    | reciprocity            | difference from the reciprocal reading, over the larger of the two or  |      |
    |                        | a tenth of the rms reading, if that is larger; NaN without a partner   |      |
    | missing                | fraction of all samples                                                |      |
    | dead, saturated, noisy | flags                                                                  |      |
    | empty                  | whether noise hides the voltage that the model expects                 |      |
    """

    frames: int
    pattern: np.ndarray
    mean: np.ndarray
    noise: np.ndarray
    snr: np.ndarray
    partner: np.ndarray
    reciprocity: np.ndarray
    missing: np.ndarray
    dead: np.ndarray
    saturated: np.ndarray
    noisy: np.ndarray
    empty: np.ndarray
    mixing: sp.csr_array | None = None

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def bad(self) -> np.ndarray:
        """Whether each reading has any flag, (readings,)."""
        return np.asarray(self.dead | self.saturated | self.noisy)


@dataclass(frozen=True)
class ElectrodeRow:
    """How far an electrode seems to sit from its place in the skin's file, by the untouched frame.

    | field        | meaning                                                                 | unit |
    |--------------|-------------------------------------------------------------------------|------|
    | x, y         | shift                                                                   | m    |
    | error        | standard error of the shift, along it                                   | m    |
    | significance | distance of the shift from zero, in standard errors of both coordinates |      |
    | elsewhere    | whether the shift is significant and not small                          |      |
    """

    electrode: int
    x: float
    y: float
    error: float
    significance: float
    elsewhere: bool


@dataclass(frozen=True)
class PressSummary:
    """Source of the presses ("table", "force" or "none"), number of usable ones, and reasons of the rejected ones."""

    source: str
    accepted: int
    rejected: tuple[tuple[int, str], ...]


@dataclass(frozen=True, eq=False)
class CheckReport:
    """Result of `check_session`. ``ok`` is False if any finding is an error.

    | field              | meaning                                                                          |
    |--------------------|----------------------------------------------------------------------------------|
    | name, title        | of the session                                                                   |
    | skin               | name of the skin that the session was checked against                            |
    | simulated          | whether the session was simulated                                                |
    | complete           | whether the recording ended as planned                                           |
    | findings           | all statements, in the order of the checks                                       |
    | streams, pads      | a row for each stream and for each pad                                           |
    | channels           | readings of the untouched skin; None: there is no stream of EIT                  |
    | order              | whether the readings have the order of the skin; None: not checked               |
    | presses            | how many presses can be used                                                     |
    | onsets             | delay of each stream behind the force, by its name                               |
    | electrodes         | places of the electrodes; empty unless they were asked for and could be checked  |
    """

    name: str
    title: str
    skin: str
    simulated: bool
    complete: bool
    findings: tuple[Finding, ...]
    streams: tuple[StreamRow, ...]
    pads: tuple[PadRow, ...]
    channels: ChannelTable | None
    order: OrderCheck | None
    presses: PressSummary
    onsets: tuple[tuple[str, OnsetDelay], ...]
    electrodes: tuple[ElectrodeRow, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether no finding spoils a calibration."""
        return all(f.severity < Severity.ERROR for f in self.findings)

    def count(self, severity: Severity) -> int:
        """Number of findings of one severity."""
        return sum(f.severity == severity for f in self.findings)


def with_health(report: CheckReport, health: str) -> CheckReport:
    """The report with a line on how far the session is off a calibration, among the notes."""
    return replace(report, findings=(*report.findings, Finding(Severity.OK, "calibration", health)))


# --- JSON ----------------------------------------------------------------------------------------


def to_json(report: CheckReport) -> str:
    """The whole report as JSON. Equal reports give equal text; NaN becomes null."""
    body = {"format": "skin-check", "ok": report.ok, **_plain(report)}
    return json.dumps(body, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Severity):
        return value.name
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def counted(count: int, noun: str, plural: str = "") -> str:
    """Number and noun, such as "1 gap" or "2 gaps"; empty for zero."""
    return f"{count} {(plural or noun + 's') if count > 1 else noun}" if count else ""


def listed(items: Iterable[object], most: int = 6) -> str:
    """The first items, separated by commas, and ", ..." if there are more than ``most``."""
    texts = [str(item) for item in items]
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")
