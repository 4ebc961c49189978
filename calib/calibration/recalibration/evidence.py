"""What gains are updated from: presses of known force, or ordinary use, which has no newtons.

At rest ordinary use tells the levels of the pads; in a contact it tells the force by the pads against the integral of
the image. A gain that all pads have in common looks like a gain of the image, so that only gains relative to each other
follow; the common one is left as it is, and its uncertainty grows by what may have drifted.
"""

import abc
from dataclasses import dataclass, field

import numpy as np

from ...check.acceptance import accept
from ...fitting.gain_update import GainDrift, GainPrior, GainUpdate, update_gains
from ...presses.table import measure, require_skin
from ...session import Session, SessionError
from ..application.force_maps import USED_PARTS
from ..calibration import Calibration
from .changes import Evidence
from .image_reference import ImageReference, fit_reference
from .loads import LoadedPads, ObservedContacts, estimator_of, expected_forces, imager, seen_contacts, use_loads
from .press_noise import PressNoise


class AbstractEvidence(abc.ABC):
    """What gains are updated from. `drift`: how far gains may have moved."""

    drift: GainDrift

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
        images = imager(calibration).presses(found.dv)
        known = np.isfinite(found.position).all(1, keepdims=True)
        place = np.where(known, found.position, images.estimated[estimator_of(calibration)])
        time = found.presses.t_hold0[found.presses.accepted]
        loads = LoadedPads(found.pressure, np.log(found.force), place, images.places, found.rest, time)
        return loads, notes + list(found.notes)

    def update(self, calibration: Calibration, loads: LoadedPads, noise: PressNoise) -> GainUpdate:
        prior = gain_prior(calibration, self.drift, together=False)
        force, _ = expected_forces(calibration, loads, prior.mean)
        covariance = noise.covariance(force.sum(1), loads.place)

        def residuals(gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            expected, slopes = expected_forces(calibration, loads, gain)
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


def gain_prior(calibration: Calibration, drift: GainDrift, *, together: bool) -> GainPrior:
    """What is known of the gains: those of the last recalibration, and what may have drifted since."""
    pads, last = len(calibration.skin.pads), calibration.recalibration
    moved = drift.covariance(pads, together=together)
    if last is None:
        return GainPrior(np.zeros(pads), moved)
    return GainPrior(last.log_gain, last.covariance + moved)


def _parts(session: Session) -> tuple[str, ...]:
    """Parts of a session whose errors count: without a table of presses and a stage no place is claimed."""
    placed = session.presses is not None or "stage" in session.streams
    return ("",) if placed else (*USED_PARTS, "/streams/force")
