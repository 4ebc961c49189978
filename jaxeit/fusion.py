"""Fusion: force maps with the shape of the contact from the image and its force from the pads.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    skin = je.load_skin("testbed")
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    recon = je.prepare(model, basis=je.Pixels(20))
    masks = je.pad_masks(skin, recon)

    near = jnp.linalg.norm(model.centroids - jnp.array([0.06, 0.13]), axis=1) < 0.01
    # S
    image = recon(je.forward(model, model.background * jnp.where(near, 1.5, 1.0)) - je.forward(model))
    forces = jnp.array([0.0, 0.0, 12.0, 0.0])  # N on each pad
    fmap = je.fuse(image, masks, forces, pad_errors=jnp.full(4, 0.1))
    print(f"{fmap.force.sum():.1f} N; the image shows where on pads {jnp.flatnonzero(fmap.valid)}")
"""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float
from numpy.typing import DTypeLike

from ._compile import is_traced, require_known, verb
from .linalg.array_libraries import real_array
from .messages.kinds import is_number, require_kind, shown
from .model.bases import AbstractPictured, overlap_areas
from .notebook import card, picture
from .skin.description import Skin

__all__ = [
    "ContactShares",
    "ForceMap",
    "FusionError",
    "PadMasks",
    "contact_shares",
    "fuse",
    "pad_masks",
]

USUAL_GATE = 0.6
"""Smallest concentration of a valid image, where no other is given; that of noise is 0.5."""


class FusionError(ValueError):
    """Masks or forces whose shape does not fit the image."""


class PadMasks(eqx.Module):
    """Share of each pad in each pixel of an image.

    | meaning                                                  | shape          | unit |
    |----------------------------------------------------------|----------------|------|
    | weights: share of each pad in each pixel; the sum over pads is at most 1 | (pads, pixels) | |
    | areas of the pixels                                      | (pixels,)      | m^2  |
    | shape: (rows, columns) of the image; None: not known     |                |      |

    Example:
        print(masks.weights @ fmap.force)  # N on each pad, as it was given
    """

    weights: Float[Array, "pads pixels"]
    areas: Float[Array, " pixels"]
    shape: tuple[int, ...] | None = eqx.field(static=True, default=None)


class ForceMap(eqx.Module):
    """Forces on the skin.

    | meaning                                                          | shape         | unit |
    |------------------------------------------------------------------|---------------|------|
    | force on each pixel; over a pad it sums to the pad's force       | (..., pixels) | N    |
    | valid: the image gives the shape; else the force is spread evenly | (..., pads)  |      |
    | concentration: positive part of the image over its magnitude     | (..., pads)   |      |
    | discarded: negative part of the image, which has no force        | (..., pads)   | S m^2|
    | areas of the pixels                                              | (pixels,)     | m^2  |
    | standard_error of each pixel's force; None: pad_errors not given | (..., pixels) | N    |
    | shape: (rows, columns) of the image; None: not known             |               |      |

    The standard error propagates the errors of the pads' forces alone, with the shape taken as exact; within a pad the
    errors of all pixels are fully correlated.

    Example:
        # N on each pixel; the first row is the lowest of the sheet
        picture = fmap.force.reshape(fmap.shape)
        print(f"{fmap.pressure.max() / 1e3:.0f} kPa, standard error {fmap.standard_error.max():.3f} N")
    """

    force: Float[Array, "... pixels"]
    valid: Bool[Array, "... pads"]
    concentration: Float[Array, "... pads"]
    discarded: Float[Array, "... pads"]
    areas: Float[Array, " pixels"]
    standard_error: Float[Array, "... pixels"] | None = None
    shape: tuple[int, ...] | None = eqx.field(static=True, default=None)

    @property
    def pressure(self) -> Float[Array, "... pixels"]:
        """Mean pressure on each pixel, (..., pixels) Pa; zero where a pixel misses the sheet."""
        area = jnp.where(self.areas > 0, self.areas, 1.0)
        return jnp.where(self.areas > 0, self.force / area, 0.0)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self.force, dtype=dtype)

    def _repr_html_(self) -> str:
        if is_traced(self):
            return card("Force map", [("state", "traced by JAX: its numbers are hidden")])
        frames = np.asarray(self.force, float).reshape(-1, self.force.shape[-1])
        if not len(frames):
            return card("Force map", [("frames", "0")])
        totals = np.nansum(frames, axis=1)
        shown = int(totals.argmax())
        pressures = np.asarray(self.pressure, float).reshape(frames.shape)[shown]
        valid = np.asarray(self.valid).reshape(len(frames), self.valid.shape[-1])[shown]
        rows = [
            ("frames", f"{len(frames):,}" + (f"; shown: {shown}, of the largest force" if len(frames) > 1 else "")),
            ("force", f"{totals[shown]:.3g} N"),
            ("largest pressure", f"{np.nanmax(pressures, initial=0.0) / 1e3:.3g} kPa"),
            ("pads whose image gives the shape", f"{int(valid.sum())} of {len(valid)}"),
        ]
        flat = self.shape is None or len(self.shape) != 2
        return card(
            "Force map", rows, "" if flat else picture(pressures.reshape(self.shape), "Pressure over the sheet")
        )


def pad_masks(skin: Skin, image: AbstractPictured) -> PadMasks:
    """Masks of the skin's pads on a pixel image, by exact areas of overlap.

    Pads that overlap share the pixel equally (a partition of unity).

    Raises:
        FusionError: if the image is not one of pixels or is that of another sheet, or a pad lies outside it.
    """
    require_known("pad_masks", FusionError, image)
    require_kind(skin, Skin, FusionError, "a skin", "one, such as jaxeit.load_skin('testbed')", "pad_masks")
    image_of = "a reconstructor, or a basis on a model, such as jaxeit.Pixels(20).on(model)"
    require_kind(image, AbstractPictured, FusionError, "an image", image_of, "pad_masks")
    if len(image.shape) != 2:
        raise FusionError("pad masks need an image of pixels; prepare with basis=Pixels(...)")
    x0, x1, y0, y1 = image.extent
    rows, columns = image.shape
    pixel = np.array([(x1 - x0) / columns, (y1 - y0) / rows])
    _require_sheet(skin, image, pixel)
    low = np.asarray(image.centres, float) - pixel / 2
    masks = [_coverage(pad.outline, low, low + pixel) for pad in skin.pads]
    weights = np.array(masks).reshape(len(skin.pads), len(low))
    areas = np.asarray(image.areas)
    for pad, mask in zip(skin.pads, weights, strict=True):
        if not (mask * areas).any():
            raise FusionError(f"pad {pad.name!r} covers no part of the image")
    weights = weights / np.maximum(weights.sum(0), 1.0)
    return PadMasks(jnp.asarray(weights, image.areas.dtype), image.areas, image.shape)


# Of the sheet's width: the mesh of a round sheet reaches nearly to its rim.
SHEET_TOLERANCE = 0.02


def _require_sheet(skin: Skin, image: AbstractPictured, pixel: np.ndarray) -> None:
    """Refuse an image that spans another rectangle than the skin's sheet; bumps reach half a ``pixel`` beyond it."""
    spanned, sheet = np.array(image.extent).reshape(2, 2).T, np.array(skin.domain.bounds)
    if (np.abs(spanned - sheet) > pixel / 2 + SHEET_TOLERANCE * np.ptp(sheet, 0)).any():
        ends = [f"({x:.3g}, {y:.3g}) to ({u:.3g}, {v:.3g}) m" for (x, y), (u, v) in (spanned, sheet)]
        raise FusionError(
            f"the image spans {ends[0]}, but the sheet of {skin.name!r} {ends[1]}; give an image of this skin"
        )


def _coverage(outline: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    outlines = np.broadcast_to(outline, (len(low), *outline.shape))
    share = overlap_areas(outlines, low, high) / np.prod(high - low, -1)
    return np.where(share > 1e-9, share, 0.0)


class ContactShares(eqx.Module):
    """Shares of several contacts in the image and in the pads' forces; from `contact_shares`.

    | meaning                                                                                   | shape            |
    |-------------------------------------------------------------------------------------------|------------------|
    | part of each pixel's change that belongs to each contact; sums to 1 over contacts          | (..., K, pixels) |
    | share of each contact in each pad's force; sums to 1, or to 0 for a pad without a contact  | (..., K, pads)   |
    | lies: part of each contact that lies on each pad; 0 for a contact that is not there        | (..., K, pads)   |
    """

    part: Float[Array, "... K pixels"]
    share: Float[Array, "... K pads"]
    lies: Float[Array, "... K pads"]

    @property
    def on(self) -> Bool[Array, "... K pads"]:
        """Whether each contact lies on each pad: with more than a twentieth of its bump, (..., K, pads)."""
        return self.lies > MIN_PART_ON_PAD


# A contact with a smaller part of its bump on a pad lies beside the pad: the tail of its bump takes no force.
MIN_PART_ON_PAD = 0.05
# Finite stand-in for the logarithm of zero: a difference of two infinities would be NaN.
LOG_OF_ZERO = -1e30


@verb
def contact_shares(
    position: Float[Array, "... K 2"],
    width: Float[Array, "... K"],
    amplitude: Float[Array, "... K"],
    centres: Float[Array, "pixels 2"],
    masks: PadMasks,
) -> ContactShares:
    """Shares of fitted contacts: on a pad, each contact's share is that of its bump's integral over the pad's mask.

    The bumps are Gaussian, ``a exp(-|x - x0|^2 / 2 s^2)``, as in `jaxeit.contacts.Contacts`. A contact with less than a
    twentieth of its bump on a pad lies beside the pad and has no share in it, unless this holds for all contacts.

    Args:
        position: (..., K, 2) m; ignored where there is no contact.
        width: standard deviation, (..., K) m.
        amplitude: (..., K) S, or any other unit; 0 where there is no contact.
        centres: of the pixels, (pixels, 2) m.
        masks: from `pad_masks`.

    Example:
        # m, two contacts on one pad, such as je.prepare_contacts finds
        places = jnp.array([[0.03, 0.13], [0.07, 0.15]])
        shares = je.fusion.contact_shares(
            places, jnp.full(2, 0.012), jnp.array([1e-3, 5e-4]), recon.centres, masks
        )
        both = je.fuse(image, masks, forces, contacts=shares)
        print(shares.share[:, 2])  # share of each contact in the force on pad 2
    """
    there = (amplitude > 0) & jnp.all(jnp.isfinite(position), -1) & (width > 0)
    place, size = jnp.where(there[..., None], position, 0), jnp.where(there, width, 1)[..., None]
    square = jnp.sum((place[..., None, :] - centres) ** 2, -1)
    log_bump = jnp.log(jnp.where(there, amplitude, 1))[..., None] - 0.5 * square / size**2
    bump = jnp.where(there[..., None], jnp.exp(log_bump), 0)
    inside, whole = bump @ (masks.weights * masks.areas).T, (bump @ masks.areas)[..., None]
    lies = inside / jnp.where(whole > 0, whole, 1)
    on = lies > MIN_PART_ON_PAD
    mine = jnp.where(on | ~jnp.any(on, -2, keepdims=True), inside, 0)
    total = mine.sum(-2, keepdims=True)
    # Computed from logarithms, because all bumps underflow to zero far from every contact.
    part = jnp.where(there[..., None], jax.nn.softmax(jnp.where(there[..., None], log_bump, LOG_OF_ZERO), -2), 0)
    return ContactShares(part, mine / jnp.where(total > 0, total, 1), lies)


def fuse(
    image: Float[ArrayLike, "... pixels"],
    masks: PadMasks,
    pad_forces: Float[ArrayLike, "... pads"] | Sequence[float],
    *,
    gate: Float[ArrayLike, ""] = USUAL_GATE,
    contacts: ContactShares | None = None,
    pad_errors: Float[ArrayLike, "... pads"] | Sequence[float] | None = None,
) -> ForceMap:
    """Distribute each pad's force over its part of the image.

    The paper's equation 4 in a bounded form: the weight of a pixel is its area times the positive
    part of its image.  Where the image over a pad is mostly noise (its positive part is less than
    ``gate`` of its magnitude; pure noise gives a half) or not finite, or the pad's force is not
    positive, the force is spread evenly over the pad and flagged as not valid.  In both cases the
    map over a pad sums to the pad's force.  A pad whose force is not finite has NaN on its own pixels only.

    Args:
        image: conductivity change, (..., pixels) S.
        masks: from `pad_masks`.
        pad_forces: (..., pads) N.
        gate: smallest concentration of a valid image, 0.5 to 1.
        contacts: from `contact_shares`. The force of a valid pad with two contacts or more is then divided by the
            contacts' shares, and each share is distributed over that contact's part of the image; the image alone
            blurs contacts together and may hide the weaker one. Default: the image alone divides the force.
        pad_errors: standard errors of the pads' forces, (..., pads) N, for the standard errors of the map.

    Raises:
        FusionError: if the shapes do not fit, numbers are not real, the gate is no number from 0 to 1, or the masks or
            contacts are none.
    """
    require_gate(gate)
    require_kind(masks, PadMasks, FusionError, "masks of pads", "those of jaxeit.pad_masks(skin, recon)", "fuse")
    if contacts is not None:
        give = "shares of jaxeit.fusion.contact_shares"
        require_kind(contacts, ContactShares, FusionError, "shares of contacts", give, "fuse")
    # numbers of Python, of lists too, would be constants of the program: another value would compile it anew
    image, forces = real_array("image", image, FusionError), real_array("pad_forces", pad_forces, FusionError)
    pads, pixels = masks.weights.shape
    if image.shape[-1:] != (pixels,) or forces.shape[-1:] != (pads,):
        raise FusionError(
            f"image {image.shape} and pad_forces {forces.shape} must end in {pixels} pixels and {pads} pads"
        )
    errors = None if pad_errors is None else real_array("pad_errors", pad_errors, FusionError)
    if errors is not None and errors.shape[-1:] != (pads,):
        raise FusionError(f"pad_errors has shape {errors.shape}; give a standard error, N, of each of {pads} pads")
    _require_one_batch({"image": image, "pad_forces": forces} | ({} if errors is None else {"pad_errors": errors}))
    return _fused(image, masks, forces, jnp.asarray(gate, masks.areas.dtype), contacts, errors)


def _require_one_batch(arrays: Mapping[str, Array]) -> None:
    """Raise FusionError unless the leading axes of arrays, which count the images of a batch, broadcast."""
    try:
        np.broadcast_shapes(*(array.shape[:-1] for array in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise FusionError(f"{shapes}: give pad forces for as many images, or for one") from None


def require_gate(gate: Float[ArrayLike, ""]) -> None:
    """Refuse a gate that is no number from 0 to 1, unless jit, grad or vmap hides it; raises `FusionError`."""
    if is_traced(gate):
        return
    if not is_number(gate) or not 0 <= np.asarray(gate) <= 1:
        raise FusionError(f"gate is {shown(gate)}; give the smallest concentration of a valid image, 0.5 to 1")


@verb
def _fused(
    image: Float[Array, "... pixels"],
    masks: PadMasks,
    forces: Float[Array, "... pads"],
    gate: Float[Array, ""],
    contacts: ContactShares | None,
    pad_errors: Float[Array, "... pads"] | None,
) -> ForceMap:
    finite = jnp.isfinite(image)
    mass = jnp.where(finite, image, 0) * masks.areas
    positive = jnp.maximum(mass, 0) @ masks.weights.T
    discarded = jnp.maximum(-mass, 0) @ masks.weights.T
    total = positive + discarded
    concentration = positive / jnp.where(total > 0, total, 1)
    missing = (~finite).astype(mass.dtype) @ masks.weights.T > 0
    known = jnp.isfinite(forces)
    valid = (concentration >= gate) & ~missing & known & (forces > 0)

    seen = jnp.maximum(mass, 0)
    shape = seen[..., None, :] if contacts is None else seen[..., None, :] * _balance(seen, masks, contacts)
    part = masks.weights * jnp.where(valid[..., None], shape, masks.areas)
    whole = part.sum(-1, keepdims=True)
    part = part / jnp.where(whole > 0, whole, 1)
    force = (part * jnp.where(known, forces, 0)[..., None]).sum(-2)
    # NaN is set last, so that it enters neither a sum nor a derivative of the other pads.
    silent = (~known).astype(mass.dtype) @ masks.weights > 0
    force = jnp.where(silent, jnp.nan, force)
    error = None if pad_errors is None else _root((part**2 * (pad_errors**2)[..., None]).sum(-2))
    return ForceMap(force, valid, concentration, discarded, masks.areas, error, masks.shape)


def _root(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root, with a gradient of zero (not NaN) at zero."""
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _balance(
    seen: Float[Array, "... pixels"], masks: PadMasks, contacts: ContactShares
) -> Float[Array, "... pads pixels"]:
    """Factor on the image over each pad that gives every contact its share; 1 for a pad with one contact.

    The share of a contact that the image does not show goes to the other contacts.
    """
    mass = (seen[..., None, :] * contacts.part) @ masks.weights.T
    there = (contacts.share > 0) & (mass > 0)
    several = there.sum(-2) > 1
    ratio = jnp.where(there, contacts.share / jnp.where(there, mass, 1), 0)
    total = mass.sum(-2)
    relative = ratio * jnp.where(several, total, 1)[..., None, :]
    factor = jnp.swapaxes(relative, -1, -2) @ contacts.part
    return jnp.where(several[..., None], factor, 1)
