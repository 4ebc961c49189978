"""Estimators of the places of contacts in a frame, from its EIT readings alone.

A choice of estimator (`FittedContact`, `ImageCentroid`) is prepared with a model. The result is a locator, which needs
neither mesh nor solver.
"""

import abc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, get_type_hints

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

import jaxeit as je
from jaxeit.messages.kinds import require_kind
from jaxeit.registry import Registry, SettingError, limited, require_limits

from ...fitting.fields import Places, single_places
from ...fitting.results import FitError


class AbstractLocator(eqx.Module):
    """Estimates the `Places` of the contacts in frames."""

    @abc.abstractmethod
    def __call__(
        self, dv: Array, image: Array, recon: je.imaging.AbstractReconstructor, masks: je.fusion.PadMasks
    ) -> Places:
        """Places of difference frames (n, readings) V with their images (n, pixels) S."""

    @property
    def contacts(self) -> int:
        """Largest number of contacts that the locator finds in a frame."""
        return 1

    def single(self) -> "AbstractLocator":
        """The same locator for frames that hold exactly one contact, as presses on a bench do."""
        return self


class CentroidLocator(AbstractLocator):
    """One contact per frame, at the position that an estimator gives of its image."""

    estimator: je.metrics.AbstractEstimator

    def __call__(
        self, dv: Array, image: Array, recon: je.imaging.AbstractReconstructor, masks: je.fusion.PadMasks
    ) -> Places:
        return single_places(self._position(image, recon), masks.weights.shape[0])

    def _position(self, image: Array, recon: je.imaging.AbstractReconstructor) -> Array:
        """The positions (n, 2) m of images (n, pixels) S; FitError for results of another shape."""
        found, shape = self.estimator(image, recon), (*image.shape[:-1], 2)
        if getattr(found, "shape", None) != shape:
            what = f"of shape {found.shape}" if hasattr(found, "shape") else f"of type {type(found).__name__}"
            raise FitError(
                f"{type(self.estimator).__name__}.__call__ returns a result {what} for images of shape {image.shape}; "
                f"return {shape}, x and y in m of each image"
            )
        return found


class ContactLocator(AbstractLocator):
    """Contacts fitted to the readings; contacts on a pad are weighted by the integrals of their bumps over its mask."""

    finder: je.contacts.ContactFinder

    @property
    def contacts(self) -> int:
        return self.finder.most

    def single(self) -> "ContactLocator":
        return ContactLocator(replace(self.finder, most=1))

    def __call__(
        self, dv: Array, image: Array, recon: je.imaging.AbstractReconstructor, masks: je.fusion.PadMasks
    ) -> Places:
        return self.placed(self.finder(dv), recon, masks)

    def contacts_of(self, dv: ArrayLike) -> je.contacts.Contacts:
        """Contacts of any number of difference frames (n, readings) V, by one program."""
        found: je.contacts.Contacts = _by_rows(self.finder, dv)
        return found

    @je.verb
    def placed(
        self, found: je.contacts.Contacts, recon: je.imaging.AbstractReconstructor, masks: je.fusion.PadMasks
    ) -> Places:
        """Convert fitted contacts to `Places`; position and width of absent contacts are NaN."""
        position = jnp.where(found.present[..., None], found.position, jnp.nan)
        width = jnp.where(found.present, found.width, jnp.nan)
        if self.finder.most == 1:
            return single_places(position[:, 0], masks.weights.shape[0], width[:, 0], found.amplitude[:, 0])
        shares = je.fusion.contact_shares(position, width, found.amplitude, recon.centres, masks)
        return Places(position, shares.share, width, found.amplitude)


ROWS = 64  # frames that are searched for contacts by one call


class AbstractLocatorChoice(abc.ABC):
    """Choice of an estimator of the place of a contact."""

    @abc.abstractmethod
    def prepare(
        self, model: je.Model, noise: np.ndarray, channels: np.ndarray, sigma: Array | None = None
    ) -> AbstractLocator:
        """Prepare the locator for a model.

        Args:
            noise: standard deviation of the readings of a frame, (readings,) V.
            channels: which readings are used, (readings,) bool.
            sigma: conductivity of the untouched sheet, (elements,) S; default: uniform.
        """


@dataclass(frozen=True)
class ImageCentroid(AbstractLocatorChoice):
    """An estimator of the place in the image: quick to prepare; the default has a mean error of 5 mm on the simulated
    testbed.

    | meaning                                                              | default                  |
    |----------------------------------------------------------------------|--------------------------|
    | estimator: one of `jaxeit.metrics.ESTIMATORS`, or a class of your own | ``je.LevelCentroid(0.5)`` |

    Raises:
        SettingError: for what is no estimator.
    """

    estimator: je.metrics.AbstractEstimator = field(default_factory=lambda: je.LevelCentroid(0.5))

    def __post_init__(self) -> None:
        give = "an object, such as je.LevelCentroid(0.5)"
        require_kind(self.estimator, je.metrics.AbstractEstimator, SettingError, "an estimator", give, "ImageCentroid")

    def prepare(
        self, model: je.Model, noise: np.ndarray, channels: np.ndarray, sigma: Array | None = None
    ) -> CentroidLocator:
        return CentroidLocator(self.estimator)


@dataclass(frozen=True)
class FittedContact(AbstractLocatorChoice):
    """Contacts fitted through the forward map (`jaxeit.prepare_contacts`), with the sheet of the untouched frames.

    | meaning                                                              | default    | unit |
    |----------------------------------------------------------------------|------------|------|
    | most: largest number of contacts per frame; 1 for presses of a bench | 2          |      |
    | columns: nodes of the table along x                                  | 31         |      |
    | widths: smallest and largest standard deviation of a contact         | 0.006, 0.03 | m   |
    """

    most: int = limited(2, least=1)
    columns: int = limited(31, least=2)
    widths: tuple[float, float] = limited((0.006, 0.03), above=0)

    def __post_init__(self) -> None:
        require_limits(self)

    def prepare(
        self, model: je.Model, noise: np.ndarray, channels: np.ndarray, sigma: Array | None = None
    ) -> ContactLocator:
        settings = je.contacts.ContactSettings(most=self.most, widths=self.widths, columns=self.columns)
        finder = je.prepare_contacts(model, settings, noise=noise, sigma=sigma, channels=channels)
        return ContactLocator(jax.tree.map(_rounded, finder))


LOCATORS = Registry(AbstractLocatorChoice, "locator", "calib.locators", parts=(je.metrics.ESTIMATORS,))
"""Choices of locator by the names that the command line and recipes use."""


# Arrays of at least this many numbers are stored in single precision. Only the table of a contact finder is so large,
# and it makes up most of a calibration file.
_SINGLE_PRECISION_SIZE = 1 << 18


def _rounded(leaf: Array) -> Array:
    """Round large tables to single precision, as they are stored, so that a loaded calibration gives equal numbers."""
    single = leaf.ndim > 0 and leaf.size >= _SINGLE_PRECISION_SIZE and jnp.issubdtype(leaf.dtype, jnp.floating)
    return jax.device_put(np.asarray(leaf).astype(np.float32).astype(leaf.dtype)) if single else leaf


def locate(
    locator: AbstractLocator,
    dv: ArrayLike,
    recon: je.imaging.AbstractReconstructor,
    masks: je.fusion.PadMasks,
    image: Array | None = None,
) -> Places:
    """`Places` of the contacts in difference frames (n, readings) V.

    `image`: images (n, pixels) S of the frames, if they are known; otherwise they are computed.

    Example:
        noise, channels = frames[rest].std(0), np.asarray(mine.recon.channels)
        for choice in (calib.calibration.ImageCentroid(je.LevelCentroid(0.5)), calibration.FittedContact(most=1)):
            model = je.discretise(je.Scene(mine.skin), je.Fidelity.draft())
            locator = choice.prepare(model, noise, channels)
            print(calibration.LOCATORS.text(choice))
            # m
            print(calib.calibration.locate(locator, dv[strongest : strongest + 1], mine.recon, mine.masks).position)
    """
    images = recon(jnp.asarray(dv, recon.dtype)) if image is None else image
    frames = np.asarray(dv, images.dtype)
    places: Places = _by_rows(lambda dv, image: locator(dv, image, recon, masks), frames, images)
    return places


def _by_rows(function: Callable[..., Any], *arrays: ArrayLike) -> Any:
    """``function`` of `ROWS` rows at a time: a search for contacts takes seconds to compile for each number of rows."""
    given = [np.asarray(array) for array in arrays]
    starts = range(0, max(len(given[0]), 1), ROWS)
    parts = [function(*(_rows(array, first) for array in given)) for first in starts]
    return jax.tree.map(lambda *part: jax.device_put(np.concatenate(part)[: len(given[0])]), *parts)


def _rows(values: np.ndarray, first: int) -> Array:
    """`ROWS` rows from `first` on; zeros after the last."""
    some = values[first : first + ROWS]
    found: Array = jax.device_put(np.concatenate([some, np.zeros((ROWS - len(some), *some.shape[1:]), some.dtype)]))
    return found


# --- as numbers, for the calibration file ----------------------------------------------------------------------------


def locator_numbers(locator: AbstractLocator) -> dict[str, np.ndarray]:
    """Every array and setting of a locator, by its path of field names joined by hyphens."""
    if isinstance(locator, CentroidLocator):
        return {"estimator": np.array([je.metrics.ESTIMATORS.text(locator.estimator)])}
    return dict(_numbers(locator))


def _numbers(module: eqx.Module, at: str = "") -> Iterator[tuple[str, np.ndarray]]:
    for part in fields(module):
        value = getattr(module, part.name)
        if isinstance(value, eqx.Module):
            yield from _numbers(value, f"{at}{part.name}-")
        elif value is not None:
            array = np.asarray(value)
            large = array.dtype == np.float64 and array.size >= _SINGLE_PRECISION_SIZE
            yield at + part.name, array.astype(np.float32) if large else array


def locator_from_numbers(numbers: dict[str, np.ndarray], dtype: Any) -> AbstractLocator:
    """The locator that `locator_numbers` described; raises KeyError for a missing array."""
    if "estimator" in numbers:
        return CentroidLocator(je.metrics.ESTIMATORS.make(str(numbers["estimator"][0])))
    locator: ContactLocator = _module(ContactLocator, numbers, "", dtype)
    return locator


def _module(kind: type, numbers: dict[str, np.ndarray], at: str, dtype: Any) -> Any:
    hints, parts = get_type_hints(kind), {}
    for part in fields(kind):
        hint = hints[part.name]
        if isinstance(hint, type) and issubclass(hint, eqx.Module):
            parts[part.name] = _module(hint, numbers, f"{at}{part.name}-", dtype)
        elif part.default is None and at + part.name not in numbers:
            parts[part.name] = None
        elif hint is int:
            parts[part.name] = int(numbers[at + part.name])
        else:
            array = numbers[at + part.name]
            parts[part.name] = jax.device_put(array.astype(dtype) if array.dtype.kind == "f" else array)
    return kind(**parts)
