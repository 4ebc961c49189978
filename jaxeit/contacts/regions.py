"""Contacts from an image: threshold, connected regions, and a watershed between summits."""

from dataclasses import dataclass

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from .._compile import require_known
from ..metrics import Pictured

Values = Float[np.ndarray, " pixels"]
Places = Int[np.ndarray, " pixels"]


class RegionError(ValueError):
    """An image that cannot be divided into regions, or a setting out of range."""


@dataclass(frozen=True, eq=False)
class Regions:
    """Contacts as regions of an image, the highest first.

    | meaning                                                        | shape     | unit  |
    |----------------------------------------------------------------|-----------|-------|
    | labels: number of the region of each pixel; -1: no region      | (pixels,) |       |
    | centres: means of position, weighted by value and area         | (k, 2)    | m     |
    | sums: integrals of the image over the regions, S_k             | (k,)      | S m^2 |
    | peaks: largest value in each region                            | (k,)      | S     |
    """

    labels: Int[np.ndarray, " pixels"]
    centres: Float[np.ndarray, "k 2"]
    sums: Float[np.ndarray, " k"]
    peaks: Float[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.peaks)


def find_regions(
    image: Float[ArrayLike, " pixels"], recon: Pictured, *, level: float = 0.5, least: float = 0.1
) -> Regions:
    """Find the regions of an image that stand out, one per contact; on the host, one image at a time.

    Pixels of at least ``level`` times the largest value are kept, and each belongs to the summit at which the steepest
    way up (over eight neighbours) ends. Of two summits whose slopes meet, the lower one
    is joined to the other unless it rises by more than ``least`` times the largest value above
    their pass, so that ripples are not contacts. A summit that does not rise that far above the threshold is
    dropped. Chen et al. 2025 (arXiv 2503.13036) divide a pad's force by ``sums``.

    Args:
        image: (pixels,) S; pixels that miss the sheet are ignored.
        recon: the reconstructor, basis map or picture that the image belongs to.
        level: threshold over the largest value, above 0 and below 1.
        least: smallest rise of a region over the largest value, 0 to 1 - ``level``.

    Returns:
        The regions; none where the image is nowhere positive.

    Raises:
        RegionError: if the image is not one picture of finite numbers, or a setting is out of range.

    Example:
        recon = je.prepare(model, basis=je.Pixels(20))
        # no model of contacts: what stands out
        regions = je.contacts.find_regions(np.asarray(recon(dv)), recon)
        print(regions.centres, regions.sums)  # m, S m^2
    """
    require_known("find_regions", RegionError, image, recon.areas, recon.centres)
    _check_settings(level, least)
    areas, values = np.asarray(recon.areas, float), _on_sheet(image, recon)
    top = values.max()
    if not top > 0:
        return Regions(np.full(values.shape, -1), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    labels = _labels(values.reshape(recon.shape) / top, level, least)
    found = labels >= 0
    number, weight = labels[found], (values * areas)[found]
    sums = np.bincount(number, weight)
    places = np.asarray(recon.centres, float)[found]
    centres = np.stack([np.bincount(number, weight * along) / sums for along in places.T], 1)
    peaks = np.zeros(len(sums))
    np.maximum.at(peaks, number, values[found])
    return Regions(labels, centres, sums, peaks)


def _check_settings(level: float, least: float) -> None:
    if not 0 < level < 1:
        raise RegionError(f"level is {level}; give a number above 0 and below 1")
    if not 0 <= least < 1 - level:
        raise RegionError(f"least is {least}; give 0 or more, and less than 1 - level = {1 - level:.6g}")


def _on_sheet(image: Float[ArrayLike, "..."], recon: Pictured) -> Values:
    if len(recon.shape) != 2:
        raise RegionError("regions need a picture; prepare with basis=Pixels(...)")
    values, areas = np.asarray(image, float), np.asarray(recon.areas)
    if values.shape != areas.shape:
        raise RegionError(f"the image has shape {values.shape}; give one image of {areas.size} pixels")
    values = np.where(areas > 0, values, 0)
    if not np.isfinite(values).all():
        raise RegionError(f"pixel {int(np.argmin(np.isfinite(values)))} of the image is not a finite number")
    return values


def _labels(picture: Float[np.ndarray, "rows columns"], level: float, least: float) -> Places:
    """Numbers of the regions, the highest first; -1 elsewhere. The largest value of ``picture`` is 1."""
    values, kept = picture.ravel(), picture.ravel() >= level
    summit = _climb(picture)
    joined = _join(summit, values, _passes(summit, values, kept.reshape(picture.shape)), least)
    tops = np.unique(joined[kept])
    tops = tops[values[tops] - level > least]
    tops = tops[np.argsort(-values[tops], kind="stable")]
    number = np.full(values.shape, -1)
    number[tops] = np.arange(len(tops))
    return np.where(kept, number[joined], -1)


def _climb(picture: Float[np.ndarray, "rows columns"]) -> Places:
    """The summit that each pixel's steepest way up ends on."""
    order = np.argsort(picture.ravel(), kind="stable")  # ranks differ also where values are equal
    rank = np.empty(order.size, int)
    rank[order] = np.arange(order.size)
    framed = np.pad(rank.reshape(picture.shape), 1, constant_values=-1)
    up = order[np.lib.stride_tricks.sliding_window_view(framed, (3, 3)).max((2, 3)).ravel()]
    while (up[up] != up).any():
        up = up[up]
    return np.asarray(up)


def _passes(summit: Places, values: Values, kept: Bool[np.ndarray, "rows columns"]) -> Int[np.ndarray, "passes 2"]:
    """Pairs of neighbouring pixels where the slopes of two summits meet, the highest pass first."""
    pixel = np.arange(kept.size).reshape(kept.shape)
    sides = [
        (pixel[:, 1:], pixel[:, :-1]),
        (pixel[1:], pixel[:-1]),
        (pixel[1:, 1:], pixel[:-1, :-1]),
        (pixel[1:, :-1], pixel[:-1, 1:]),
    ]
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in sides])
    pairs = pairs[kept.ravel()[pairs].all(1) & (summit[pairs[:, 0]] != summit[pairs[:, 1]])]
    return np.asarray(pairs[np.argsort(-values[pairs].min(1), kind="stable")])


def _join(summit: Places, values: Values, passes: Int[np.ndarray, "passes 2"], least: float) -> Places:
    """The summit that each pixel belongs to after ripples are joined to their neighbours."""
    into = np.arange(values.size)
    for pair in passes:
        low, high = sorted((_root(into, int(s)) for s in summit[pair]), key=lambda s: values[s])
        if low != high and values[low] - values[pair].min() <= least:
            into[low] = high
    while (into[into] != into).any():
        into = into[into]
    return np.asarray(into[summit])


def _root(into: Places, place: int) -> int:
    while into[place] != place:
        place = int(into[place])
    return place
