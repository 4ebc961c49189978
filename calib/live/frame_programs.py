"""Programs that process a single frame: force map, forces of pads, and contacts."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxeit as je
from jaxeit.tracking import Track

from ..calibration.application.force_maps import ForceModel, filled, fused, is_loaded
from ..calibration.localisation.locators import ContactLocator
from ..fitting.fields import Places
from ..fitting.fields.places import nowhere
from .follower import padded
from .results import NO_TOUCHES, TouchEstimates

IMAGE_DTYPE = "float32"  # of the image product; its matrices are built in float64, but read in half the memory

T = TypeVar("T")


class FrameForces(NamedTuple):
    """Forces of one frame, on the host.

    | field                 | meaning                                           | shape     | unit |
    |-----------------------|---------------------------------------------------|-----------|------|
    | map                   | force on each pixel                               | (pixels,) | N    |
    | force, standard_error | of each pad                                       | (pads,)   | N    |
    | valid                 | whether the pressure is within the fitted range   | (pads,)   |      |
    | loaded                | whether the pad is pressed                        | (pads,)   |      |
    | negative              | whether the pressure is as far below zero         | (pads,)   |      |
    | image                 | change of conductivity from which the map is made | (pixels,) | S    |
    """

    map: np.ndarray
    force: np.ndarray
    standard_error: np.ndarray
    valid: np.ndarray
    loaded: np.ndarray
    negative: np.ndarray
    image: np.ndarray


class FramePrograms:
    """Programs that process a single frame.

    The image is a NumPy product, which takes less time than a call of JAX. Forces and contacts are one compiled
    program each. `warm_up` runs all of them once before the first frame arrives.
    """

    def __init__(self, model: ForceModel, followed: int | None = None):
        """`followed`: largest number of contacts that a tracker tells; None: the calibration's locator tells them."""
        self._model, self.gains = model, model.pads.gains
        self._image = model.recon.on_host(IMAGE_DTYPE)
        self._dtypes = model.recon.dtype, model.pads.dtype
        # The numbers of the model are constants of the program, which takes two thirds off the overhead of a call; only
        # the gains of the pads may change while it runs.
        self._map = _compiled(lambda gains, *a: _packed_forces(model.moved(gains), *a))
        leaves, tree = jax.tree.flatten(model)
        search = _compiled(lambda leaves, *a: _find_contacts(jax.tree.unflatten(tree, leaves), *a))
        self._search = partial(search, leaves)  # not constants, because the table of responses takes megabytes
        contacts = model.locator.finder.most if isinstance(model.locator, ContactLocator) else 1
        self._followed = followed
        self.nowhere = nowhere(
            jnp.zeros((1, model.masks.weights.shape[0]), self._dtypes[0]), contacts if followed is None else followed
        )
        centres, masks = model.recon.centres, model.masks
        self._shares = _compiled(
            lambda position, width, force: je.fusion.contact_shares(position, width, force, centres, masks).share
        )

    @property
    def searches(self) -> bool:
        """Whether contacts are located frame by frame."""
        return self._model.locator is not None and self._followed is None

    def warm_up(self) -> None:
        """Run all programs once, also for a frame without readings."""
        readings, pads = self._model.recon.readings, self._model.masks.weights.shape[0]
        frame = np.zeros(readings)
        self.map(frame, np.zeros(pads), self.nowhere, np.zeros((1, pads)))
        self._image(np.full(readings, np.nan))
        if self.searches:
            self.search(frame)
        if self._followed is not None:
            self.placed(())

    def map(self, frame: np.ndarray, pressure: np.ndarray, places: Places, before: np.ndarray) -> FrameForces:
        """Forces from a difference frame (readings,) V, pressures (pads,) Pa and those ``before`` (m, pads)."""
        image = self._image(frame)
        row = self._map(self.gains, image[None], self._row(pressure, 1), places, filled(self._model, before))
        return _unpack_forces(np.asarray(row), pressure.size, image)

    def search(self, frame: np.ndarray) -> tuple[Places, TouchEstimates]:
        """Locate the contacts of a difference frame (readings,) V."""
        places, found = self._search(self._row(frame, 0))
        return jax.block_until_ready(places), NO_TOUCHES if found is None else _touch_estimates(jax.device_get(found))

    def placed(self, tracks: tuple[Track, ...]) -> Places:
        """Places of contacts that are followed."""
        assert self._followed is not None
        if self._model.pads.field is None:
            return self.nowhere
        parts = [jnp.asarray(part, self._dtypes[0]) for part in padded(tracks, self._followed)]
        position, width, force = parts
        return Places(position, self._shares(position, width, force), width, force)

    def _row(self, values: np.ndarray, which: int) -> np.ndarray:
        return np.asarray(values[None], self._dtypes[which])


def _compiled(function: Callable[..., T]) -> Callable[..., T]:
    return jax.jit(function, compiler_options=je.compiler_options())


def _packed_forces(model: ForceModel, image: Array, pressure: Array, places: Places, before: Array | None) -> Array:
    """The fields of `FrameForces` in one row, so that one transfer from the device suffices."""
    image = image.astype(model.recon.dtype)
    found = fused(
        model, image, pressure, places if model.pads.field is not None else None, before, je.fusion.USUAL_GATE
    )
    loaded, negative = is_loaded(model, pressure), is_loaded(model, -pressure)
    parts = found.map.force, found.force, found.standard_error, found.valid, loaded, negative
    return jnp.concatenate([part[0].astype(found.force.dtype) for part in parts])


def _unpack_forces(row: np.ndarray, pads: int, image: np.ndarray) -> FrameForces:
    force, error, valid, loaded, negative = row[-5 * pads :].reshape(5, pads)
    return FrameForces(row[: -5 * pads], force, error, valid > 0, loaded > 0, negative > 0, image)


def _find_contacts(model: ForceModel, frame: Array) -> tuple[Places, je.contacts.Contacts | None]:
    """Places, and the contacts from which they come; None for a locator that fits no contacts."""
    if isinstance(model.locator, ContactLocator):
        found = model.locator.finder(frame)
        return model.locator.placed(found, model.recon, model.masks), found
    assert model.locator is not None
    return model.locator(frame, model.recon(frame), model.recon, model.masks), None


def _touch_estimates(found: je.contacts.Contacts) -> TouchEstimates:
    present, position, covariance, result = (
        np.asarray(part[0]) for part in (found.present, found.position, found.covariance, found.result)
    )
    return TouchEstimates(
        position[present], covariance[present, :2, :2], result[present] == je.contacts.ContactResult.CONVERGED, 0
    )
