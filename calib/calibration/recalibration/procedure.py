"""Recalibration: the same calibration, moved, from presses of known force or from ordinary use (`evidence`)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import jax.numpy as jnp
import numpy as np

from jaxeit.messages.kinds import require_kind

from ...fitting.curves.fitted import predict_pads
from ...fitting.gain_update import GainDrift, GainUpdate
from ...session import Session, SessionError
from ...session.argument_checks import require_session
from ..argument_checks import require_calibration
from ..calibration import Calibration
from ..fitted_sessions import SAME_NOTE, holds_presses, is_fitted, require_not_moved_by
from ..logs.calibration import LogCalibration
from ..logs.recalibration import recalibrate_log
from .changes import ANYWAY, MAX_DRIFTS, Evidence, Recalibration, beyond_drift
from .evidence import AbstractEvidence, KnownForces, OrdinaryUse, gain_prior
from .loads import LoadedPads, expected_forces
from .press_noise import PressNoise, press_noise
from .records import recorded, rest_levels
from .skins import other_skin

C = TypeVar("C", Calibration, LogCalibration)

MIN_PRESSES = 3  # of a session that can be used; fewer are refused
BEYOND = 0.3  # of the calibrated range of pressure, by which the pads may read more than was calibrated
MIN_SHARE = 0.02  # of a press; a pad with less of it counts as not loaded


def recalibrate(
    calibration: C, session: Session, evidence: AbstractEvidence | None = None, *, ignore_errors: bool = False
) -> C:
    """The same calibration, moved to what the pads read in a session. `Calibration.recalibration` says by how much.

    The calibration of a log is moved by a log of known force, as `calib.calibration.recalibrate_log` does.

    Args:
        evidence: default: `KnownForces` for a session with a force stream, otherwise `OrdinaryUse`.
        ignore_errors: use also a session in which `check_session` finds an error, and note it.

    Raises:
        SessionError: if the session was recorded on another skin, has too few presses or contacts, or determines the
            gain of no pad, or has moved the calibration before; or if a gain has moved by more than three
            standard deviations of what may have drifted, as by a force in kg.
        RecordingError: if `check_session` finds an error in what is used of the session.
    """
    require_session(session, "recalibrate")
    if isinstance(calibration, LogCalibration):
        return recalibrate_log(calibration, session, _drift_of_log(evidence), ignore_errors=ignore_errors)
    require_calibration(calibration, "recalibrate")
    return _moved(calibration, session, evidence, ignore_errors)


def _moved(
    calibration: Calibration, session: Session, evidence: AbstractEvidence | None, ignore_errors: bool
) -> Calibration:
    """`recalibrate` for the calibration of a skin."""
    require_not_moved_by(calibration.provenance, session)
    found = assess(calibration, session, evidence, ignore_errors=ignore_errors)
    if not ignore_errors:
        _require_plausible(found, calibration, evidence, session)
    history = [calibration.provenance.get("recalibrations", ""), found.summary()]
    return replace(
        calibration,
        recalibration=found,
        rest=found.offset,
        provenance=calibration.provenance
        | {"recalibrations": "\n".join(filter(None, history)), "recalibrated_utc": found.until},
        simulated=calibration.simulated or session.simulated,
        notes=(*calibration.notes, found.health, *found.notes),
    )


def _require_plausible(
    found: Recalibration, calibration: Calibration, evidence: AbstractEvidence | None, session: Session
) -> None:
    """Refuse a session that determines no gain, and gains that have moved beyond all drift, as by a wrong unit."""
    if not found.determined.any():
        raise SessionError(f"{session.name}: {found.health}; {ANYWAY}")
    drift = GainDrift() if evidence is None else evidence.drift
    use = found.evidence is Evidence.ORDINARY_USE
    expected = np.sqrt(np.diag(gain_prior(calibration, drift, together=use).covariance))
    if (np.abs(found.change) > MAX_DRIFTS * expected)[found.determined].any():
        raise SessionError(f"{session.name}: {found.moves}, {beyond_drift(float(expected.max()))}; {ANYWAY}")


def _drift_of_log(evidence: AbstractEvidence | None) -> GainDrift | None:
    """How far a log may have moved, of the evidence for it; SessionError for other evidence than known forces."""
    give = "calib.calibration.KnownForces(), as the calibration is of a log, which only known force can move"
    require_kind(evidence or KnownForces(), KnownForces, SessionError, "evidence for a log", give, "recalibrate")
    return evidence.drift if isinstance(evidence, KnownForces) else None


def assess(
    calibration: Calibration,
    session: Session,
    evidence: AbstractEvidence | None = None,
    *,
    ignore_errors: bool = False,
) -> Recalibration:
    """How far a session is off a calibration, without changing it; arguments and errors as for `recalibrate`.

    Example:
        with calib.open_session("other.h5") as session:
            change = calibration.assess(mine, session)  # KnownForces, as the session has a load cell
            # pads against the image
            unloaded = calibration.assess(mine, session, calibration.OrdinaryUse())
        print(change.health, change.log_gain, unloaded.advice)
    """
    require_session(session, "assess")
    require_calibration(calibration, "assess", "assess it by calib.calibration.assess_log")
    if session.skin_name and session.skin_name != calibration.skin.name:
        raise SessionError(
            f"{session.name}: recorded on the skin {session.skin_name!r}, but the calibration is of "
            f"{calibration.skin.name!r}; give the calibration of this skin"
        )
    way = evidence or (KnownForces() if "force" in session.streams else OrdinaryUse())
    loads, notes = way.read(calibration, session, ignore_errors)
    same = [SAME_NOTE] if _is_known(calibration, way, loads, session) else []
    return judge(calibration, way, loads, session, [*same, *other_skin(calibration, session), *notes])


def _is_known(calibration: Calibration, way: AbstractEvidence, loads: LoadedPads, session: Session) -> bool:
    """Whether a calibration was fitted to a session, or to most of its presses of known force."""
    if is_fitted(calibration.provenance, session):
        return True
    return way.kind is Evidence.KNOWN_FORCE and holds_presses(calibration, np.exp(loads.observed), loads.pressure)


def judge(
    calibration: Calibration, way: AbstractEvidence, loads: LoadedPads, session: Session, notes: Sequence[str] = ()
) -> Recalibration:
    """How far presses or contacts of a session are off a calibration.

    Raises:
        SessionError: if too few of them can be used.
    """
    noise = press_noise(calibration.evaluation)
    loads, update, more = _updated(calibration, way, loads, noise, session)
    force = np.maximum(expected_forces(calibration, loads, update.mean)[0], 0)
    count = (force / force.sum(1, keepdims=True)).sum(0)
    origin = session.epoch, f"{session.hash}  {session.name}"
    return recorded(calibration, way.kind, update, count, rest_levels(loads.rest, loads.time), origin, [*notes, *more])


def _updated(
    calibration: Calibration, way: AbstractEvidence, loads: LoadedPads, noise: PressNoise, session: Session
) -> tuple[LoadedPads, GainUpdate, list[str]]:
    """The update by what lies in the calibrated range, once with the gains of before and once with those found."""
    start = gain_prior(calibration, GainDrift(), together=False).mean
    kept, notes = _in_range(calibration, loads, start, BEYOND, noise)
    _require_enough(session, way.kind, len(kept.observed), notes)
    update = way.update(calibration, kept, noise)
    within, more = _in_range(calibration, kept, update.mean, 0.05, noise)
    if more and len(within.observed) >= MIN_PRESSES:
        return within, way.update(calibration, within, noise), notes + more
    return kept, update, notes


def _require_enough(session: Session, kind: Evidence, count: int, notes: list[str]) -> None:
    if count < MIN_PRESSES:
        thing = "presses" if kind is Evidence.KNOWN_FORCE else "contacts"
        why = f" ({notes[0]})" if notes else ""
        raise SessionError(
            f"{session.name}: only {count} {thing} can be used{why}, too few to recalibrate; press each pad three "
            "times or more within the calibrated forces"
        )


def _in_range(
    calibration: Calibration, loads: LoadedPads, gain: np.ndarray, beyond: float, noise: PressNoise
) -> tuple[LoadedPads, list[str]]:
    """The presses within the calibrated range of pressure and of some force, and a note on the others."""
    if not len(loads.observed):
        return loads, []
    force, _ = expected_forces(calibration, loads, gain)
    own = replace(calibration.pads, gains=None).own(jnp.asarray(loads.pressure * np.exp(-gain)))
    inside = np.asarray(predict_pads(calibration.curves, own.T, beyond).valid).T
    total = force.sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        bears = force > MIN_SHARE * total[:, None]
    strong = np.isfinite(total) & (total > max(noise.least_force, 1e-6))
    keep = strong & (inside | ~bears).all(1)
    out = int((strong & ~keep).sum())
    notes = [f"{out} of {len(keep)} left out: outside the calibrated range of pressure"] if out else []
    faint = int((~strong).sum())
    return loads.rows(keep), notes + ([f"{faint} of {len(keep)} left out: too faint"] if faint else [])
