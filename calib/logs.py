"""Logs of force and a signal without EIT: one curve per log, tested on what it has not seen."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .curves import AbstractCurve, curve_name
from .fit import FitError
from .presses import resample
from .response import LogFit, fit_log, time_split
from .session import Session, Stream, write_archive

FORMAT = "pressure-force-curves"
_NOT_SIGNALS = ("force", "stage", "temperature", "barometer")


def fit_session(session: Session, curve: AbstractCurve | Sequence[AbstractCurve]) -> LogFit:
    """Fit force against the session's signal on its first half; the second half is held out.

    The signal is the stream "pressure", or the only one that is not a force, a place or the weather;
    it is interpolated to the times of the force. Of several curves the one is taken that, fitted on the first half of
    the first half, predicts the rest of it best: the second half has no say.

    Raises:
        SessionError, FitError: if a stream is missing or nothing can be fitted.
    """
    force, signal = session.stream("force"), _signal(session)
    values = resample(signal.time, signal.read(), force.time)
    loads = force.read()[:, 0]
    if isinstance(curve, AbstractCurve):
        return fit_log(curve, force.time, values, loads)
    first, _ = time_split(force.time)
    tried = [fit_log(c, force.time[first], values[first], loads[first]).held_out.rmse for c in curve]
    return fit_log(curve[int(np.argmin(np.nan_to_num(tried, nan=np.inf)))], force.time, values, loads)


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


def render_log(name: str, fit: LogFit) -> str:
    """The fit as lines for a terminal."""
    curve, held = fit.fitted.curve, fit.held_out
    numbers = zip(
        curve.names,
        np.asarray(fit.fitted.parameters),
        np.asarray(fit.fitted.standard_errors),
        curve.units,
        strict=True,
    )
    terms = ", ".join(f"{n} {v:.4g} +- {e:.2g} {u}" for n, v, e, u in numbers)
    return (
        f"{name}: {curve_name(curve)} curve of {fit.source}: {fit.fitted.message()}\n"
        f"  {terms}\n"
        f"  force RMSE: first half (fitted) {fit.train.rmse:.3f} N, second half (held out) "
        f"{held.rmse:.3f} N = {held.percent_full_scale:.1f} % of full scale, {held.n} samples\n"
        f"  {fit.missing} samples without a force or a signal left out"
    )


def save_logs(fits: Mapping[str, LogFit], path: str | Path) -> None:
    """Write the curves of several logs, whole or not at all."""
    arrays: dict = {}
    for number, (name, fit) in enumerate(fits.items()):
        at = f"logs/{number}/"
        fitted = fit.fitted
        arrays |= {
            at + "name": (np.array([name]), "", "session"),
            at + "curve": (np.array([curve_name(fitted.curve)]), "", "law"),
            at + "source": (np.array([fit.source]), "", "what the signal is made of"),
            at + "parameters": (np.asarray(fitted.parameters), "", ", ".join(fitted.curve.units)),
            at + "covariance": (np.asarray(fitted.covariance), "", "of the parameters"),
            at + "held_out_rmse": (np.array([fit.held_out.rmse]), "N", "on the second half"),
        }
    write_archive(path, FORMAT, {"logs": len(fits)}, arrays)
