"""Recalibration: the same calibration, moved, from presses of known force or from ordinary use.

Known force: each press says how much its pads read per newton. Ordinary use has no newtons. At rest it tells the
levels of the pads; in a contact it tells the force by the pads against the integral of the image. A gain that all pads
have in common looks like a gain of the image, so that only gains relative to each other follow; the common one is left
as it is, and its uncertainty grows by what may have drifted.
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxeit as je
from jaxeit.messages.kinds import require_kind

from ...check.acceptance import accept
from ...fitting.curves.fitted import predict_pads
from ...fitting.curves.samples import by_rows
from ...fitting.fields import Places
from ...fitting.gain_update import GainDrift, GainPrior, GainUpdate, update_gains
from ...fitting.pad_gains import gain_slopes
from ...presses.table import measure, require_skin
from ...session import Session, SessionError
from ...session.given import require_session
from ..application.force_maps import USED_PARTS, ForceModel, force_model, unmoved_forces
from ..calibration import Calibration
from ..fitted_sessions import SAME_NOTE, holds_presses, is_fitted, require_not_moved_by
from ..given import require_calibration
from ..localisation.press_images import Imager
from ..logs.calibration import LogCalibration
from ..logs.recalibration import recalibrate_log
from .changes import Evidence, Recalibration
from .image_reference import ImageReference, fit_reference
from .ordinary_use import distinct, use_contacts
from .press_noise import PressNoise, press_noise
from .skins import other_skin

C = TypeVar("C", Calibration, LogCalibration)

MIN_PRESSES = 3  # of a session that can be used; fewer are refused
BEYOND = 0.3  # of the calibrated range of pressure, by which the pads may read more than was calibrated
MIN_SHARE = 0.02  # of a press; a pad with less of it counts as not loaded


class LoadedPads(NamedTuple):
    """Presses or contacts from which gains follow.

    | field    | meaning                                                   | shape     | unit |
    |----------|-----------------------------------------------------------|-----------|------|
    | pressure | change of the pads                                        | (n, pads) | Pa   |
    | observed | log of the known force, or of the integral of the image   | (n,)      |      |
    | place    | estimated                                                 | (n, 2)    | m    |
    | places   | as the force laws take them; None: no field               |           |      |
    | rest     | level of the pads at rest                                 | (m, pads) | Pa   |
    | time     | of the levels                                             | (m,)      | ns   |
    """

    pressure: np.ndarray
    observed: np.ndarray
    place: np.ndarray
    places: Places | None
    rest: np.ndarray
    time: np.ndarray

    def rows(self, keep: np.ndarray) -> "LoadedPads":
        """Some of the presses, and all levels."""
        places = None if self.places is None else self.places[jnp.asarray(np.flatnonzero(keep))]
        return self._replace(
            pressure=self.pressure[keep], observed=self.observed[keep], place=self.place[keep], places=places
        )


class ObservedContacts(NamedTuple):
    """Contacts as the update of relative gains takes them; the logs of their forces are linear in the log gains.

    | field    | meaning                                                             | shape     | unit |
    |----------|---------------------------------------------------------------------|-----------|------|
    | observed | log of the integral of the image                                    | (n,)      |      |
    | place    | estimated                                                           | (n, 2)    | m    |
    | force    | of each pad, at the log gains `gain`                                | (n, pads) | N    |
    | slopes   | of the total force, in minus the log gains                          | (n, pads) | N    |
    | gain     | log gains                                                           | (pads,)   |      |
    """

    observed: np.ndarray
    place: np.ndarray
    force: np.ndarray
    slopes: np.ndarray
    gain: np.ndarray


class RestLevels(NamedTuple):
    """Mean and standard deviation (pads,) Pa of the levels at rest; their drift and its standard error, Pa/h."""

    mean: np.ndarray
    deviation: np.ndarray
    drift: np.ndarray
    drift_error: np.ndarray


class AbstractEvidence(abc.ABC):
    """What gains are updated from."""

    @property
    @abc.abstractmethod
    def kind(self) -> Evidence:
        """Its name."""

    @abc.abstractmethod
    def read(self, calibration: Calibration, session: Session, ignore_errors: bool) -> tuple[LoadedPads, list[str]]:
        """Presses or contacts of a session, and notes on what was left out."""

    @abc.abstractmethod
    def update(self, calibration: Calibration, loads: LoadedPads, noise: PressNoise) -> GainUpdate:
        """Update the gains of the calibration."""


@dataclass(frozen=True)
class KnownForces(AbstractEvidence):
    """Presses with a load cell; a pad that is not pressed stays as it is. `drift`: how far gains may have moved.

    Example:
        with calib.open_session("other.h5") as session:
            moved = calib.recalibrate(mine, session, calibration.KnownForces())
        print(moved.recalibration.gains)
    """

    drift: GainDrift = field(default_factory=GainDrift)

    @property
    def kind(self) -> Evidence:
        return Evidence.KNOWN_FORCE

    def read(self, calibration: Calibration, session: Session, ignore_errors: bool) -> tuple[LoadedPads, list[str]]:
        found = measure(session, calibration.skin, calibration.processing, place_needed=False)
        notes = list(accept([session], calibration.skin, ignore_errors=ignore_errors, where=_parts(session)).notes)
        images = _imager(calibration).presses(found.dv)
        known = np.isfinite(found.position).all(1, keepdims=True)
        place = np.where(known, found.position, images.estimated[estimator_of(calibration)])
        time = found.presses.t_hold0[found.presses.accepted]
        loads = LoadedPads(found.pressure, np.log(found.force), place, images.places, found.rest, time)
        return loads, notes + list(found.notes)

    def update(self, calibration: Calibration, loads: LoadedPads, noise: PressNoise) -> GainUpdate:
        prior = gain_prior(calibration, self.drift, together=False)
        force, _ = _expected(calibration, loads, prior.mean)
        covariance = noise.covariance(force.sum(1), loads.place)

        def residuals(gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            expected, slopes = _expected(calibration, loads, gain)
            total = expected.sum(1)
            return np.log(total) - loads.observed, slopes / total[:, None]

        return update_gains(prior, residuals, covariance)


@dataclass(frozen=True)
class OrdinaryUse(AbstractEvidence):
    """Levels at rest, and pads against the image in contacts. `drift`: how far gains may have moved."""

    drift: GainDrift = field(default_factory=GainDrift)

    @property
    def kind(self) -> Evidence:
        return Evidence.ORDINARY_USE

    def read(self, calibration: Calibration, session: Session, ignore_errors: bool) -> tuple[LoadedPads, list[str]]:
        require_skin(session, calibration.skin, {name: session.stream(name) for name in ("eit", "pressure")})
        notes = list(accept([session], calibration.skin, ignore_errors=ignore_errors, where=USED_PARTS).notes)
        return use_loads(calibration, session), notes

    def update(self, calibration: Calibration, loads: LoadedPads, noise: PressNoise) -> GainUpdate:
        prior = gain_prior(calibration, self.drift, together=True)
        seen = seen_contacts(calibration, loads, prior.mean)
        return update_from_use(prior, image_reference(calibration), noise, seen)


def use_loads(calibration: Calibration, session: Session) -> LoadedPads:
    """Single contacts of a session, each between two rests, and the levels of the pads at rest."""
    found = use_contacts(session, calibration)
    sound = np.isfinite(found.pressure).all(1)
    sound &= np.isfinite(found.dv[:, np.asarray(calibration.recon.channels)]).all(1)
    loads = contact_loads(calibration, found.dv[sound], found.pressure[sound], found.contact[sound])
    return loads._replace(rest=found.rest, time=found.time)


def contact_loads(
    calibration: Calibration, dv: np.ndarray, pressure: np.ndarray, contact: np.ndarray | None = None
) -> LoadedPads:
    """Single contacts, from changes of frames (n, readings) V and of pressures (n, pads) Pa.

    `contact` (n,) numbers the contacts of which these are parts; without it each is a contact of its own.
    """
    images = _imager(calibration).presses(dv)
    place = images.estimated[estimator_of(calibration)]
    single = np.isfinite(place).all(1) & (images.integral > 0)
    every = calibration.locate(dv)
    if every is not None:
        single &= np.isfinite(np.asarray(every.position)).all(-1).sum(1) == 1
    if contact is not None:
        near = press_noise(calibration.evaluation).length
        rows = np.flatnonzero(single)
        single[rows] = distinct(contact[rows], place[rows], pressure[rows].sum(1), near)
    integral = np.where(images.integral > 0, images.integral, 1.0)
    loads = LoadedPads(pressure, np.log(integral), place, images.places, np.empty((0, pressure.shape[1])), np.empty(0))
    return loads.rows(single)


def seen_contacts(calibration: Calibration, loads: LoadedPads, gain: np.ndarray) -> ObservedContacts:
    """Contacts with the forces of their pads at log gains (pads,)."""
    return ObservedContacts(loads.observed, loads.place, *_expected(calibration, loads, gain), gain)


def image_reference(calibration: Calibration) -> ImageReference:
    """The integral of the image per newton at the calibration.

    Raises:
        SessionError: if the calibration has too few presses.
    """
    found = calibration.evaluation
    try:
        return fit_reference(found.estimated[estimator_of(calibration)], found.force, found.image_sum)
    except ValueError as error:
        raise SessionError(f"calibration: {error}; recalibrate from presses of known force") from None


def update_from_use(
    prior: GainPrior, reference: ImageReference, noise: PressNoise, seen: ObservedContacts
) -> GainUpdate:
    """Update gains relative to each other by contacts; the common gain keeps its mean, and its deviation grows."""
    total = seen.force.sum(1)
    mean, spread, bend = reference.predict(seen.place, total)
    sensitivity = (1 + bend)[:, None] * seen.slopes / total[:, None]
    surplus = np.log(total) + mean - seen.observed

    def residuals(gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return surplus - sensitivity @ (gain - seen.gain), sensitivity

    covariance = spread + noise.with_scatter(reference.scatter).covariance(total, seen.place)
    # A gain of the image, and one of all pads, which reaches each contact by its own sensitivity.
    nuisance = np.stack([np.ones(len(total)), sensitivity.sum(1)], 1)
    return update_gains(prior, residuals, covariance, nuisance)


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
            gain of no pad, or has moved the calibration before.
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
    if not found.determined.any() and not ignore_errors:
        raise SessionError(f"{session.name}: {found.health}; or move it all the same (--force, ignore_errors=True)")
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
    force = np.maximum(_expected(calibration, loads, update.mean)[0], 0)
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
    force, _ = _expected(calibration, loads, gain)
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


def recorded(
    calibration: Calibration,
    kind: Evidence,
    update: GainUpdate,
    count: np.ndarray,
    levels: RestLevels,
    origin: tuple[str, str],
    notes: Sequence[str] = (),
) -> Recalibration:
    """The record of an update; `origin`: time and name of what it rests on."""
    pads = tuple(pad.name for pad in calibration.skin.pads)
    before = np.zeros(len(pads)) if calibration.recalibration is None else calibration.recalibration.log_gain
    rest = np.full(len(pads), np.nan) if calibration.rest is None else np.asarray(calibration.rest)
    return Recalibration(
        log_gain=update.mean,
        covariance=update.covariance,
        before=before,
        determined=update.determined,
        count=count,
        offset=levels.mean,
        offset_change=levels.mean - rest,
        offset_error=levels.deviation,
        drift=levels.drift,
        drift_error=levels.drift_error,
        misfit=float(update.misfit),
        scatter=float(update.scatter),
        evidence=kind,
        pads=pads,
        session=origin[1],
        since=_recorded(calibration),
        until=origin[0],
        notes=(*notes, *_undetermined_notes(kind, update, pads, np.sqrt(np.diag(update.covariance)))),
    )


def _undetermined_notes(kind: Evidence, update: GainUpdate, pads: tuple[str, ...], error: np.ndarray) -> list[str]:
    """What the data do not determine."""
    unknown = [
        f"{name} (+- {100 * e:.0f} %)" for name, ok, e in zip(pads, update.determined, error, strict=True) if not ok
    ]
    notes = [f"hardly determines the gain of {', '.join(unknown)}"] if unknown else []
    if kind is Evidence.ORDINARY_USE:
        notes.append(
            "a gain common to all pads cannot be told from one of the image without known force: left as it was, "
            "with the uncertainty of what may have drifted"
        )
    outliers = int((update.weight < 0.3).sum())
    return notes + ([f"{outliers} of {len(update.weight)} are outliers and weigh little"] if outliers else [])


def rest_levels(levels: np.ndarray, time: np.ndarray) -> RestLevels:
    """Summary of levels (m, pads) Pa at times (m,) ns; the drift is NaN for fewer than three levels."""
    hours, mean = np.asarray(time, float) / 3.6e12, levels.mean(0)
    unknown = np.full(levels.shape[1], np.nan)
    if len(levels) < 3 or not np.ptp(hours) > 0:
        return RestLevels(mean, levels.std(0), unknown, unknown)
    lever = hours - hours.mean()
    slope = lever @ (levels - mean) / (lever @ lever)
    left = levels - mean - np.outer(lever, slope)
    error = np.sqrt((left**2).sum(0) / (len(levels) - 2) / (lever @ lever))
    return RestLevels(mean, levels.std(0, ddof=1), slope, error)


def _recorded(calibration: Calibration) -> str:
    known = calibration.provenance
    names = ("recalibrated_utc", "recorded_utc", "created_utc")
    return next((known[name] for name in names if name in known), "")


def gain_prior(calibration: Calibration, drift: GainDrift, *, together: bool) -> GainPrior:
    """What is known of the gains: those of the last recalibration, and what may have drifted since."""
    pads, last = len(calibration.skin.pads), calibration.recalibration
    moved = drift.covariance(pads, together=together)
    if last is None:
        return GainPrior(np.zeros(pads), moved)
    return GainPrior(last.log_gain, last.covariance + moved)


def _expected(calibration: Calibration, loads: LoadedPads, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pad forces (n, pads) N at log gains, and the slopes (n, pads) of the total in minus the log gains."""
    model = force_model(calibration).moved(None)
    then = np.asarray(loads.pressure * np.exp(-gain), model.pads.dtype)
    force, slope = by_rows(_forces_and_slopes, then, loads.places, before=(model,))
    return force.astype(float), slope.astype(float)


@je.verb
def _forces_and_slopes(
    model: ForceModel, pressures: Float[Array, "n pads"], places: Places | None
) -> tuple[Float[Array, "n pads"], Float[Array, "n pads"]]:
    response: Callable[[Array], Array] = lambda p: unmoved_forces(model, p, places)  # noqa: E731
    return response(pressures), gain_slopes(response, pressures).sum(-1).T


def _imager(calibration: Calibration) -> Imager:
    return Imager(calibration.recon, calibration.masks, calibration.locator)


def estimator_of(calibration: Calibration) -> str:
    """The estimator of the place that the calibration knows best."""
    return "fitted" if calibration.locator is not None and "fitted" in calibration.evaluation.estimated else "half"


def _parts(session: Session) -> tuple[str, ...]:
    """Parts of a session whose errors count: without a table of presses and a stage no place is claimed."""
    placed = session.presses is not None or "stage" in session.streams
    return ("",) if placed else (*USED_PARTS, "/streams/force")
