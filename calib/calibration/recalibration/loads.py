"""Presses and contacts from which gains follow, and the forces that a calibration expects of them."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxeit as je

from ...fitting.curves.samples import by_rows
from ...fitting.fields import Places
from ...fitting.pad_gains import gain_slopes
from ...session import Session
from ..application.force_maps import ForceModel, force_model, unmoved_forces
from ..calibration import Calibration
from ..localisation.press_images import Imager
from .ordinary_use import distinct, use_contacts
from .press_noise import press_noise


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
    images = imager(calibration).presses(dv)
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
    return ObservedContacts(loads.observed, loads.place, *expected_forces(calibration, loads, gain), gain)


def expected_forces(calibration: Calibration, loads: LoadedPads, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def imager(calibration: Calibration) -> Imager:
    """What makes images of presses and estimates their places, as the calibration does."""
    return Imager(calibration.recon, calibration.masks, calibration.locator)


def estimator_of(calibration: Calibration) -> str:
    """The estimator of the place that the calibration knows best."""
    return "fitted" if calibration.locator is not None and "fitted" in calibration.evaluation.estimated else "half"
