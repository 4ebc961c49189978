"""Logs of force and a signal, without EIT: one curve per log, fitted on its first half and tested on its second."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..check.acceptance import accept
from ..fitting.channel_faults import MIN_ARRAY_CHANNELS, faults
from ..fitting.curves import CURVES, AbstractCurve, Linear
from ..fitting.logs import BlendChannels, LogFit, SmoothChannels, fit_log, time_split
from ..fitting.losses import AbstractLoss, SoftL1
from ..fitting.results import FitError, FitResult
from ..fitting.selection import Tried, simplest
from ..presses.streams import resample
from ..session import Session, Stream, write_archive

Way = BlendChannels | SmoothChannels | None
"""Method that combines several channels into one signal; None for a single channel."""

FORMAT = "pressure-force-curves"
_NOT_SIGNALS = ("force", "stage", "temperature", "barometer")
_WAYS = {"blend": BlendChannels(), "Gaussian process": SmoothChannels()}  # one signal, in N, of several channels
_STRETCHES = 10  # stretches of time with a mean error each, because neighbouring samples are correlated


@dataclass(frozen=True, eq=False)
class SessionFit:
    """The fit of a session's log.

    | meaning                                                                |
    |------------------------------------------------------------------------|
    | fit: curve and held-out errors                                         |
    | unit: of the signal that the curve maps to force                       |
    | why: reason for the choice of channels and curve; empty: no choice     |
    | note: ignored errors, and channels left out for lack of information    |
    """

    fit: LogFit
    unit: str
    why: str = ""
    note: str = ""

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the curve's parameters."""
        return tuple(unit.replace("Pa", self.unit) for unit in self.fit.fitted.curve.units)


def fit_session(
    session: Session,
    curves: Sequence[AbstractCurve],
    loss: AbstractLoss | None = None,
    *,
    ignore_errors: bool = False,
) -> SessionFit:
    """Fit force against the session's signal on its first half; the second half is held out.

    The signal is the stream "pressure", or the only stream besides force, stage, temperature and barometer. It is
    interpolated to the times of the force. If several curves are given, each is fitted on the first quarter of the log,
    and one is chosen by the errors on the second quarter (see `simplest`); the held-out second half has no influence.
    For several channels, the method that combines them is chosen in the same way first: a static blend, or a Gaussian
    process that models creep. Channels of a wide array that are dead, stuck or silent on the first half are left out.

    Args:
        ignore_errors: fit also a session in which `check_session` finds an error, and note it.

    Raises:
        SessionError, FitError: if a stream is missing or nothing can be fitted.
        RecordingError: if `check_session` finds an error in the session.
    """
    ignored = accept([session], None, ignore_errors=ignore_errors)
    force, signal = session.stream("force"), _signal(session)
    values = resample(signal.time, signal.read(), force.time)
    log = _Log(force.time, values, force.read()[:, 0], loss or SoftL1())
    log, note = _informative(log, f"{session.name}: /streams/{signal.name}")
    unit = "N" if signal.channels > 1 else _unit(signal)
    note = "; ".join(filter(None, [*ignored, note]))
    if len(curves) == 1:
        fit, why = fit_log(curves[0], log.time, log.values, log.force, loss=log.loss), ""
    else:
        fit, why = _chosen(log, curves)
    _require_fit(session, fit)
    return SessionFit(fit, unit, why, note)


def _require_fit(session: Session, fit: LogFit) -> None:
    fitted = fit.fitted
    if not _converged(fit) or not np.isfinite(np.asarray(fitted.parameters)).all() or not np.isfinite(fit.train.rmse):
        curve = CURVES.name_of(fitted.curve)
        raise FitError(f"{session.name}: the {curve} curve could not be fitted: {fitted.message()}")


def _converged(fit: LogFit) -> bool:
    return int(fit.fitted.result) == FitResult.SUCCESS


def _unit(signal: Stream) -> str:
    return "count" if signal.variable == "counts" else signal.unit


def _informative(log: "_Log", where: str) -> tuple["_Log", str]:
    """The log without the channels of a wide array that carry no information, and a note that names these."""
    channels = log.values.shape[1]
    if channels < MIN_ARRAY_CHANNELS:
        return log, ""
    half = log.first()  # the second half is held out, and must not decide which channels are used
    found = faults(half.values, half.force)
    if not found.uninformative.any():
        return log, ""
    if found.uninformative.all():
        raise FitError(f"{where}: none of {channels} channels follows the force; see jaxeit check")
    flags = {"dead": found.dead, "stuck": found.stuck, "silent": found.silent}
    named = [f"{name} {', '.join(map(str, np.flatnonzero(flag)))}" for name, flag in flags.items() if flag.any()]
    note = f"channels left out: {'; '.join(named)}"
    return replace(log, values=log.values[:, ~found.uninformative]), note


@dataclass(frozen=True, eq=False)
class _Log:
    """Times (n,) ns, values (n, channels), force (n,) N, and the loss of the fits."""

    time: np.ndarray
    values: np.ndarray
    force: np.ndarray
    loss: AbstractLoss

    def first(self) -> "_Log":
        """The first half of the log."""
        rows, _ = time_split(self.time)
        return _Log(self.time[rows], self.values[rows], self.force[rows], self.loss)

    def signal(self, way: Way) -> tuple[np.ndarray, str]:
        """Combine all channels into one signal, fitted on the first half; returns the signal and its description."""
        if way is None:
            return self.values, "channel 0"
        rows, _ = time_split(self.time)
        known = rows & np.isfinite(self.values).all(1) & np.isfinite(self.force)
        return way(self.time, self.values, np.where(known, self.force, np.nan), Linear())

    def errors(self, curve: AbstractCurve, signal: np.ndarray) -> np.ndarray:
        """Mean square errors (stretches,) N^2 on the second half of a curve fitted on the first; NaN without a fit."""
        fit = fit_log(curve, self.time, signal, self.force, loss=self.loss)
        if not _converged(fit):
            return np.full(_STRETCHES, np.nan)
        predicted = fit.predicted
        _, rest = time_split(self.time)
        rest &= np.isfinite(self.force) & np.isfinite(signal.reshape(len(rest), -1)).all(1)
        return np.array([np.mean(part**2) for part in np.array_split((predicted - self.force)[rest], _STRETCHES)])


def _chosen(log: _Log, curves: Sequence[AbstractCurve]) -> tuple[LogFit, str]:
    """Choose channels and curve on the first half of the log, then fit them on all of it; returns the fit and why."""
    half = log.first()
    ways = _WAYS if log.values.shape[1] > 1 else {"channel": None}
    made = cache(lambda way: half.signal(way)[0])
    tried = [Tried(way, name, order) for order, (name, way) in enumerate(ways.items())]
    way, why, _ = simplest("channels", tried, lambda way: half.errors(Linear(), made(way)), "stretches of time")
    tried = [Tried(curve, CURVES.name_of(curve), curve.size) for curve in curves]
    curve, more, _ = simplest("curve", tried, lambda curve: half.errors(curve, made(way)), "stretches of time")
    signal, source = log.signal(way)
    fit = replace(fit_log(curve, log.time, signal, log.force, loss=log.loss), source=source)
    return fit, "; ".join(filter(None, [why, more]))


def _signal(session: Session) -> Stream:
    if "pressure" in session.streams:
        return session.streams["pressure"]
    left = [name for name in session.streams if name not in _NOT_SIGNALS]
    if len(left) != 1:
        raise FitError(
            f"{session.name}: which stream is the signal? found {', '.join(left) or 'none'}; import "
            "it under the name pressure"
        )
    return session.streams[left[0]]


def render_log(name: str, found: SessionFit) -> str:
    """The fit as lines for a terminal."""
    fit = found.fit
    curve, held = fit.fitted.curve, fit.held_out
    numbers = zip(
        curve.names,
        np.asarray(fit.fitted.parameters),
        np.asarray(fit.fitted.standard_errors),
        found.units,
        strict=True,
    )
    terms = ", ".join(f"{n} {v:.4g} +- {e:.2g} {u}" for n, v, e, u in numbers)
    why = f"  chosen: {found.why}\n" if found.why else ""
    note = f"\n  note: {found.note}" if found.note else ""
    return (
        f"{name}: {CURVES.name_of(curve)} curve of {fit.source}: {fit.fitted.message()}\n{why}"
        f"  {terms}\n"
        f"  force RMSE: first half (fitted) {fit.train.rmse:.3f} N, second half (held out) "
        f"{held.rmse:.3f} N = {held.percent_full_scale:.1f} % of full scale, {held.n} samples\n"
        f"  {fit.missing} samples without a force or a signal left out{note}"
    )


def save_logs(fits: Mapping[str, SessionFit], path: str | Path, **attributes: str | float) -> None:
    """Write the curves of several logs, whole or not at all; ``attributes`` are kept with them."""
    arrays: dict[str, Any] = {}
    for number, (name, found) in enumerate(fits.items()):
        at = f"logs/{number}/"
        fit, fitted = found.fit, found.fit.fitted
        arrays |= {
            at + "name": (np.array([name]), "", "session"),
            at + "curve": (np.array([CURVES.name_of(fitted.curve)]), "", "law"),
            at + "source": (np.array([fit.source]), "", "what the signal is made of"),
            at + "parameters": (np.asarray(fitted.parameters), "", ", ".join(found.units)),
            at + "covariance": (np.asarray(fitted.covariance), "", "of the parameters"),
            at + "held_out_rmse": (np.array([fit.held_out.rmse]), "N", "on the second half"),
        }
    write_archive(path, FORMAT, {"logs": len(fits), **attributes}, arrays)
