"""Whether a session agrees with a calibration that is applied to it, though nobody asked for a recalibration.

Four things are looked at: the skin that the session describes, the presses or contacts against what was calibrated
(pressures and places), the levels of the pads at rest, and the gains of the pads against the image, or against known
force. Gains that the image says have moved do not move forces, which is what a recalibration does; they widen the
intervals.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri

from ...fitting.intervals import student_factor
from ...presses.table import PressMeasurements
from ...session import Session, SessionError
from ..calibration import Calibration
from ..localisation.press_images import PressImages
from .changes import Advice, Recalibration
from .evidence import KnownForces, OrdinaryUse
from .loads import LoadedPads, estimator_of, use_loads
from .ordinary_use import MAX_OBSERVATIONS
from .press_noise import place_spacing
from .procedure import MIN_SHARE, judge
from .skins import other_skin

# Change of a level at rest, as a part of the largest calibrated pressure, from which it is worth a line. The level
# itself is taken off all pressures; a large change means another sensor, supply or air.
REST_CHANGE = 0.03
# Part of the presses outside what was calibrated from which it is worth a line.
MIN_OUTSIDE = 0.02
CERTAIN = 0.95  # probability, without a move, of moves that are smaller than those taken for real


class Agreement(NamedTuple):
    """Result of a comparison of a session with a calibration.

    | field       | meaning                                                                             |
    |-------------|-------------------------------------------------------------------------------------|
    | calibration | the calibration, its gains as uncertain as pads and image disagree                  |
    | notes       | what lies outside of what was calibrated or has moved, a line each                  |
    """

    calibration: Calibration
    notes: tuple[str, ...]


def agreement_of_presses(calibration: Calibration, found: PressMeasurements, images: PressImages) -> Agreement:
    """The agreement of measured presses of known force, whose images are known; forces do not change intervals."""
    place = images.estimated[estimator_of(calibration)]
    time = found.presses.t_hold0[found.presses.accepted]
    sound = np.isfinite(place).all(1) & (images.integral > 0) & (found.force > 0)
    rows = np.flatnonzero(sound)
    rows = rows[np.unique(np.linspace(0, max(len(rows) - 1, 0), MAX_OBSERVATIONS).astype(int))] if len(rows) else rows
    places = None if images.places is None else images.places[jnp.asarray(rows)]
    integral, force = images.integral[rows], found.force[rows]
    loads = LoadedPads(found.pressure[rows], np.log(integral), place[rows], places, found.rest, time)
    by_image = _judged(calibration, loads, found.session, OrdinaryUse())
    by_force = _judged(calibration, loads._replace(observed=np.log(force)), found.session, KnownForces())
    return _agreement(calibration, found.session, loads, by_image, by_force)


def agreement_of_use(calibration: Calibration, session: Session) -> Agreement:
    """The agreement of the contacts of a session, without known forces."""
    loads = use_loads(calibration, session)
    found = _judged(calibration, loads, session, OrdinaryUse())
    return _agreement(calibration, session, loads, found, found)


def _judged(
    calibration: Calibration, loads: LoadedPads, session: Session, way: OrdinaryUse | KnownForces
) -> Recalibration | None:
    """How far the gains have moved; None if there are too few presses or contacts to tell."""
    try:
        return judge(calibration, way, loads, session)
    except SessionError:
        return None


def _agreement(
    calibration: Calibration,
    session: Session,
    loads: LoadedPads,
    by_image: Recalibration | None,
    told: Recalibration | None,
) -> Agreement:
    notes = [*other_skin(calibration, session), *_outside(calibration, loads), *_moved_rest(calibration, loads.rest)]
    if told is not None and told.advice in (Advice.RECALIBRATE, Advice.CALIBRATE):
        notes.append(told.health)
    return Agreement(calibration if by_image is None else widened(calibration, by_image), tuple(notes))


def widened(calibration: Calibration, found: Recalibration) -> Calibration:
    """The calibration, its gains as they are, and more uncertain by what ordinary use says they moved."""
    doubt = covariance_of_moves(found.change[found.determined], found.change_error[found.determined])
    if not doubt.any():
        return calibration
    last, pads = calibration.recalibration, len(found.change)
    covariance = np.zeros((pads, pads)) if last is None else np.array(last.covariance)
    covariance[np.ix_(found.determined, found.determined)] += doubt
    return replace(calibration, recalibration=replace(found, log_gain=found.before, covariance=covariance))


def covariance_of_moves(change: Float[np.ndarray, " n"], error: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Covariance of the log gains of pads that have moved relative to each other by as much, with these errors.

    The square of a move exceeds its expectation by the variance of the move, which is taken off. The image tells moves
    of n pads relative to each other only. Where pads move independently of each other, the squares of these sum up to
    (n - 1) variances of a move, and the mean of all moves, which looks like a gain of the image, has an nth of it. So
    few moves tell their variance roughly: the mean has Student's distribution. Moves that may be errors tell nothing.
    """
    square, count = np.maximum(change**2 - error**2, 0.0), len(change)
    if count < 2 or np.sum(change**2) <= chdtri(count - 1, 1 - CERTAIN) * np.mean(error**2):
        return np.diag(square)
    common = student_factor(count - 1) ** 2 * square.sum() / (count * (count - 1))
    return np.asarray(np.diag(square) + common)


def _outside(calibration: Calibration, loads: LoadedPads) -> list[str]:
    """Lines about presses beyond the calibrated pressures, or beside the calibrated places."""
    if not len(loads.pressure):
        return []
    force, _, valid = calibration.pad_forces(loads.pressure, loads.places)
    bears = force > MIN_SHARE * force.sum(1, keepdims=True)
    parts = {"pressures": (bears & ~valid).any(1)}
    if calibration.field is not None:
        parts["places"] = _beside(loads.place, calibration.evaluation.position)
    return [
        f"outside the calibrated {name}: {flags.sum()} of {len(flags)} presses, whose forces are extrapolated"
        for name, flags in parts.items()
        if flags.mean() > MIN_OUTSIDE
    ]


def _beside(place: Float[np.ndarray, "n 2"], calibrated: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " n"]:
    """Flags of places that lie outside the box of the calibrated ones by more than these are apart."""
    margin = place_spacing(calibrated)
    return np.asarray(((place < calibrated.min(0) - margin) | (place > calibrated.max(0) + margin)).any(1))


def _moved_rest(calibration: Calibration, rest: Float[np.ndarray, "m pads"]) -> list[str]:
    """A line about pads whose level at rest is another than at the calibration."""
    if calibration.rest is None or not len(rest):
        return []
    change = np.nanmean(rest, 0) - calibration.rest
    far = np.abs(change) > REST_CHANGE * np.asarray(calibration.curves.pressure_range)[:, 1]
    names = [pad.name for pad in calibration.skin.pads]
    named = ", ".join(f"{change[i]:+.0f} Pa ({names[i]})" for i in np.flatnonzero(far))
    return [f"pads at rest read otherwise than at the calibration: {named}"] if named else []
