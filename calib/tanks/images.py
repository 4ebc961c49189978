"""Images of tanks: differences relative to the even content that the reference frame shows, and absolute ones."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxeit as je
from jaxeit.imaging import (
    AbsoluteImage,
    AbstractHyperparameter,
    AbstractIterativeMethod,
    AbstractLinearMethod,
    AbstractPenalty,
    ConvergenceError,
    IterativeReconstructor,
    ReferenceFit,
    ReferenceSettings,
    Segmentation,
    fit_reference,
    segment,
)
from jaxeit.model import AbstractBasis

from .recording import Tank, TankError

LEAST_CORRELATION = 0.5
"""Correlation of the reference with the model below which order, polarity or geometry cannot be right."""

OPPOSITE = -0.8
"""Correlation below which the polarity alone is wrong, since the order and the places are nearly those of the model."""


class TankConductivity(NamedTuple):
    """An absolute image of a tank.

    | meaning                                                                  |
    |--------------------------------------------------------------------------|
    | shown: the image and its conductivity                                    |
    | model: of the tank, with the contacts that were fitted                   |
    | fit: conductivity and contacts that the reference tells, where asked for |
    """

    shown: AbsoluteImage
    model: je.Model
    fit: ReferenceFit | None = None


class TankImage(NamedTuple):
    """A difference image.

    | meaning                                                                  | shape          | unit |
    |--------------------------------------------------------------------------|----------------|------|
    | change of conductivity over that of the reference                        | (basis,)       | 1    |
    | recon: the reconstructor, whose ``shape``, ``extent`` belong to the image |               |      |
    | background: conductivity of the reference, if its content is even        | ()             | S    |
    | correlation of the reference with the model of even content              | ()             | 1    |
    | fit: conductivity and contacts that the reference tells, where asked for |                |      |
    """

    change: Float[Array, " basis"]
    recon: je.Reconstructor | IterativeReconstructor
    background: float
    correlation: float
    fit: ReferenceFit | None = None


def difference_image(
    tank: Tank,
    frame: int = -1,
    reference: int = 0,
    *,
    prior: je.AbstractPrior | None = None,
    method: AbstractLinearMethod | AbstractIterativeMethod | None = None,
    basis: AbstractBasis | None = None,
    hyperparameter: float | AbstractHyperparameter = 0.3,
    normalised: bool = False,
    fidelity: je.Fidelity | None = None,
    fit: ReferenceSettings | None = None,
) -> TankImage:
    """The change from one frame to another.

    One conductivity is fitted to the reference, by which the size of current and tank, and a gain, have no part in the
    image. Readings that are NaN in either frame are left out.

    Args:
        frame, reference: numbers of the frames.
        prior, method, basis, hyperparameter: as for `je.prepare`; default basis: 40 pixels along x. The default
            hyperparameter suits tanks whose geometry is known to a few percent (docs/tanks.md). A way to choose one
            looks at the difference of the two frames, unless it has frames of its own.
        normalised: weigh each change by the reading of the reference, as where instruments err in proportion.
        fidelity: default: draft, with quadratic elements if ``fit`` is given, as linear ones add a contact resistance
            to each electrode: 10 % of that of the tank in tests/imaging/test_reference.py.
        fit: fit conductivity and contacts, or gains and offsets of channels, to the reference by
            `je.imaging.fit_reference`, for the image;
            default: contacts as the tank has them.

    Raises:
        TankError: if there is one frame, the reference does not look like the model, or its fit does not converge.
        InverseError: if ``fit`` is given, and no even content explains the reference.
    """
    scaled = _scaled(tank, frame, reference, fidelity, fit)
    model = scaled.model
    dv = jnp.asarray(scaled.after - scaled.before, model.dtype)
    weight = hyperparameter.on(dv) if isinstance(hyperparameter, AbstractHyperparameter) else hyperparameter
    noise = _own_size(scaled.before) if normalised else None
    recon = je.prepare(model, prior, method, basis or je.Pixels(40), noise=noise, hyperparameter=weight)
    change = recon(dv) / model.background[0]
    return TankImage(change, recon, scaled.gain * float(model.background[0]), scaled.correlation, scaled.fit)


def _own_size(readings: np.ndarray) -> np.ndarray:
    """The size of each reading; those that are missing or zero have that of a typical one."""
    size = np.abs(readings)
    found: np.ndarray = np.where(np.isfinite(size) & (size > 0), size, np.sqrt(np.nanmean(size**2)))
    return found


def conductivity_image(
    tank: Tank,
    frame: int = -1,
    *,
    reference: int = 0,
    penalty: AbstractPenalty | None = None,
    error: float = 0.01,
    basis: AbstractBasis | None = None,
    fidelity: je.Fidelity | None = None,
    fit: ReferenceSettings | None = None,
) -> TankConductivity:
    """The conductivity that one frame alone shows, by `je.imaging.absolute_image`.

    What the model misses of the tank is in the image: a wrong contact, current or place of an electrode looks like an
    object at the rim.

    Args:
        reference: a frame of even content, for ``fit`` alone.
        penalty, error, basis: as for `je.imaging.absolute_image`.
        fidelity, fit: as for `difference_image`; default: contacts as the tank has them.

    Raises:
        TankError: if there is no such frame, it does not look like the model, or the fit does not converge.
        InverseError: if ``fit`` is given, and no even content explains the reference.

    Example:
        recorded = calib.tanks.load_npz("tank.npz", disc)
        settings = {"basis": je.Pixels(12), "error": 1e-3, "fidelity": je.Fidelity.draft(edge_length=0.1)}
        shown = calib.tanks.conductivity_image(recorded, **settings).shown
        print(f"{shown.sigma.min():.2g} to {shown.sigma.max():.2g} S")
    """
    count = len(tank.frames)
    if not (-count <= frame < count and -count <= reference < count):
        raise TankError(f"{tank.skin.name}: has {count} frames; there is no frame {frame} or {reference}")
    model = tank.model(fidelity or je.Fidelity.draft(order=1 if fit is None else 2))
    _correlated(tank, model, tank.frames[frame], frame % count)
    found = None if fit is None else _fitted(tank, model, tank.frames[reference], reference % count, fit)
    seen = tank.frames[frame]
    if found is not None:
        model, seen = found.model, np.asarray(found.corrected(seen))
    shown = je.imaging.absolute_image(model, seen, basis, penalty=penalty, error=error)
    return TankConductivity(shown, model, found)


def segmented_frame(
    tank: Tank,
    frame: int = -1,
    reference: int = 0,
    *,
    basis: AbstractBasis | None = None,
    fidelity: je.Fidelity | None = None,
    fit: ReferenceSettings | None = None,
) -> Segmentation:
    """What conducts less and more in one frame than in another, by `je.imaging.segment`.

    Arguments and errors as for `difference_image`.
    """
    scaled = _scaled(tank, frame, reference, fidelity, fit)
    return segment(scaled.model, scaled.before, scaled.after, basis)


class _Scaled(NamedTuple):
    """Two frames times the gain with which the model reads like the first of them."""

    model: je.Model
    before: np.ndarray
    after: np.ndarray
    gain: float
    correlation: float
    fit: ReferenceFit | None


def _scaled(
    tank: Tank, frame: int, reference: int, fidelity: je.Fidelity | None, fit: ReferenceSettings | None
) -> _Scaled:
    count = len(tank.frames)
    if not all(-count <= number < count for number in (frame, reference)) or (frame - reference) % count == 0:
        raise TankError(
            f"{tank.skin.name}: frame {frame} less frame {reference}, of {count} frames; give two different ones"
        )
    first, last = reference % count, frame % count
    model = tank.model(fidelity or je.Fidelity.draft(order=1 if fit is None else 2))
    before, after = tank.frames[first], tank.frames[last]
    used = np.isfinite(before) & np.isfinite(after)
    if used.sum() < 3:
        raise TankError(f"{tank.skin.name}: the frames share {int(used.sum())} finite readings; more are needed")
    if not np.ptp(before[used]):
        raise TankError(
            f"{tank.skin.name}: all readings of frame {first} are the same number; give a recorded frame as reference"
        )
    correlation = _correlated(tank, model, np.where(used, before, np.nan), first)
    found = None if fit is None else _fitted(tank, model, np.where(used, before, np.nan), first, fit)
    if found is not None:
        model, (before, after) = found.model, np.asarray(found.corrected(np.stack([before, after])))
    even = np.asarray(je.forward(model))
    alike = float(even[used] @ before[used])
    if not alike > 0:
        raise TankError(
            f"{tank.skin.name}: the readings of frame {first} follow an even tank, and have an offset that turns their "
            "sign; take it out, or fit it: fit=ReferenceSettings(offset=...), --fit-offset with --fit-contacts"
        )
    scale = float(even[used] @ even[used]) / alike  # least squares of the readings: the errors are theirs
    return _Scaled(model, scale * before, scale * after, scale, correlation, found)


def _correlated(tank: Tank, model: je.Model, frame: np.ndarray, number: int) -> float:
    """The correlation of a frame with even content; refuses a frame of another order, polarity or geometry."""
    used = np.isfinite(frame)
    correlation = float(np.corrcoef(np.asarray(je.forward(model))[used], frame[used])[0, 1])
    if not correlation > LEAST_CORRELATION:
        raise TankError(
            f"{tank.skin.name}: the correlation of frame {number} with a model of even content is {correlation:.2f}; "
            "check the order and the polarity of readings, and the place and direction of electrodes"
            + ("; it seems to be the polarity: save the readings with the other sign" if correlation < OPPOSITE else "")
        )
    return correlation


def _fitted(tank: Tank, model: je.Model, frame: np.ndarray, number: int, fit: ReferenceSettings) -> ReferenceFit:
    """The conductivity and contacts of a frame; refuses what the fit does not find."""
    try:
        return fit_reference(model, frame, fit)
    except ConvergenceError:
        raise TankError(
            f"{tank.skin.name}: the fit of conductivity and contacts to frame {number} does not converge, as where "
            "contacts are better than the mesh resolves; leave out --fit-contacts (fit=None)"
        ) from None
