"""Sessions without EIT in a batch: one pressure-force curve each, fitted by `calib.calibration.logs`."""

import contextlib
from collections.abc import Mapping

from ..calibration.logs import FORMAT, fit_session, save_logs
from ..calibration.recipe import Recipe
from ..calibration.recipe_text import AUTO_CURVES
from ..fitting.curves import CURVES, AbstractCurve
from ..session import Session, SessionError, read_archive

SUMMARY = ("samples", "force_rmse", "force_rmse_percent_full_scale")
"""Statistics in the summary of a log, computed on its held-out second half."""


def log_summary(path: str, mark: str) -> dict[str, float]:
    """The summary of a log that was fitted with this mark; empty if no such fit exists."""
    with contextlib.suppress(SessionError):
        attributes = read_archive(path, FORMAT).attrs
        if attributes.get("batch") == mark:
            return {name: float(attributes[name]) for name in SUMMARY}
    return {}


def fit_log_into(
    path: str, session: Session, recipe: Recipe, mark: str, ignore_errors: bool = False
) -> Mapping[str, float]:
    """Fit the curve of a session without EIT, write it with its mark, and return its summary.

    Raises:
        SessionError, FitError: if a stream is missing or nothing can be fitted.
        RecordingError: if `check_session` finds an error in the session, unless errors are ignored.
    """
    found = fit_session(session, _curves(recipe), recipe.loss, ignore_errors=ignore_errors)
    held = found.fit.held_out
    summary = dict(zip(SUMMARY, map(float, (held.n, held.rmse, held.percent_full_scale)), strict=True))
    save_logs({session.name: found}, path, batch=mark, **summary)
    return summary


def _curves(recipe: Recipe) -> tuple[AbstractCurve, ...]:
    """The curves of the recipe; for "auto" all shipped curves, because a log has enough samples to choose."""
    automatic = [type(CURVES.make(name)) for name in AUTO_CURVES]
    if [type(curve) for curve in recipe.curves] == automatic:
        return tuple(CURVES.make(name) for name in CURVES.shipped)
    return recipe.curves
