"""What a network is to say of a frame: its kind, and loads of all kinds that come nearest to the contacts.

Loads of a kind that is not the true one have the force, the middle and the second moments of the true ones, so that
they are where a fit of that kind would begin.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxeit.contacts import MIN_RELATIVE_STRENGTH, LoadKind, LoadSettings

from ..bench import Footprint, TrainingFrames

TINY = 1e-9  # N
# Second moment of a footprint along each axis, over the square of its size; that of an edge is along itself.
MOMENTS = {Footprint.DISC: 0.25, Footprint.RING: 0.5}


class Targets(NamedTuple):
    """Kinds (frames,), loads in the order of `SHAPES` of the proposal, and of which kinds there are any (frames, 4)."""

    kind: Int[np.ndarray, " frames"]
    loads: Float[np.ndarray, "frames 30"]
    known: Bool[np.ndarray, "frames 4"]


class Counted(NamedTuple):
    """Contacts of frames that count, the strongest first; those that do not have no force.

    | meaning                                                   | shape                 | unit |
    |-----------------------------------------------------------|-----------------------|------|
    | number of contacts                                        | (frames,)             | 1    |
    | place, force of each                                      | (frames, contacts, 2) | m, N |
    | half: from the middle of an edge to its end; 0 for others | (frames, contacts, 2) | m    |
    | across: second moment of each along an axis, across edges | (frames, contacts)    | m^2  |
    """

    number: np.ndarray
    place: np.ndarray
    force: np.ndarray
    half: np.ndarray
    across: np.ndarray


def targets_of(frames: TrainingFrames | Mapping[str, np.ndarray]) -> Targets:
    """Kinds and loads of frames.

    A contact with less than `MIN_RELATIVE_STRENGTH` of the force of the strongest does not count, as for
    `jaxeit.contacts.ContactFinder`. Contacts nearer than `LoadSettings.nearest` to another and edges shorter than
    `LoadSettings.shortest` count as one load, as for `LoadFitter`.
    """
    found = _counted(frames)
    kind, (one, halves, edge) = _kinds(found), _moments(found)
    edge[kind == LoadKind.EDGE, 4:] = found.half[kind == LoadKind.EDGE, 0]
    width = _log_width(found.across + np.sum(found.half**2, -1) / 6)
    each = np.concatenate([found.place, np.stack([width, np.log(np.maximum(found.force, TINY))], -1)], -1)
    two = np.where((found.number == 2)[:, None, None], each[:, :2], halves)
    loads = np.concatenate([one, two.reshape(-1, 8), edge, each.reshape(-1, 12)], 1)
    touched = found.number > 0
    return Targets(kind, loads, np.column_stack([touched, touched, touched, found.number == 3]))


def _counted(frames: TrainingFrames | Mapping[str, np.ndarray]) -> Counted:
    order = np.argsort(-frames["contact_force"], axis=1, kind="stable")
    force, size, footprint, angle = (
        np.take_along_axis(frames[f"contact_{name}"], order, 1) for name in ("force", "size", "footprint", "angle")
    )
    counts = (force > 0) & (force >= MIN_RELATIVE_STRENGTH * force[:, :1])
    place = np.take_along_axis(frames["contact_place"].astype(float), order[..., None], 1)
    half = size[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1) * (footprint == Footprint.EDGE)[..., None]
    across = frames["load_spread"][:, None].astype(float) ** 2
    across = across + sum(value * size**2 * (footprint == shape) for shape, value in MOMENTS.items())
    return Counted(counts.sum(1), place, np.where(counts, force, 0.0), half, across)


def _moments(found: Counted) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One load (frames, 4), two halves of it (frames, 2, 4), and an edge (frames, 6), with the moments of all."""
    share = found.force / np.maximum(found.force.sum(1, keepdims=True), TINY)
    middle = np.einsum("nk,nkd->nd", share, found.place)
    away = found.place - middle[:, None]
    moment = np.einsum("nk,nkd,nke->nde", share, away, away)
    moment += np.einsum("nk,nkd,nke->nde", share / 3, found.half, found.half)
    total, across = np.log(np.maximum(found.force.sum(1), TINY)), np.einsum("nk,nk->n", share, found.across)
    one = np.column_stack([middle, _log_width(across + 0.5 * np.trace(moment, axis1=1, axis2=2)), total])
    least, direction = _principal(moment)
    width = _log_width(across + least)
    halves = [np.column_stack([middle + sign * direction, width, total - np.log(2)]) for sign in (1, -1)]
    return one, np.stack(halves, 1), np.column_stack([middle, width, total, np.sqrt(3) * direction])


def _log_width(variance: np.ndarray) -> np.ndarray:
    found: np.ndarray = 0.5 * np.log(np.maximum(variance, 1e-6))
    return found


def _principal(moment: Float[np.ndarray, "n 2 2"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """The smaller second moment, and the direction of the larger one with the length of its excess."""
    values, vectors = np.linalg.eigh(moment)
    return values[:, 0], np.sqrt(np.maximum(values[:, 1:] - values[:, :1], 0)) * vectors[:, :, 1]


def _kinds(found: Counted) -> np.ndarray:
    """Kinds of frames, by the number of contacts that are not near one before."""
    usual, most = LoadSettings(), found.place.shape[1]
    distance = np.linalg.norm(found.place[:, :, None] - found.place[:, None], axis=-1)
    there = np.arange(most) < found.number[:, None]
    near = (distance < usual.nearest) & np.tri(most, k=-1, dtype=bool) & there[:, None]
    apart = (there & ~near.any(2)).sum(1)
    length = 2 * np.linalg.norm(found.half[:, 0], axis=1)
    kinds = np.array([LoadKind.NONE, LoadKind.ONE, LoadKind.TWO, LoadKind.MORE])[apart]
    return np.where((found.number == 1) & (length >= usual.shortest), LoadKind.EDGE, kinds)
