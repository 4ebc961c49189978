"""Contacts by the image route: threshold, connected regions, and a watershed between summits."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from .metrics import Pictured


class RegionError(ValueError):
    """An image in which no regions can be told."""


@dataclass(frozen=True, eq=False)
class Regions:
    """Contacts as regions of an image, the highest first.

    | meaning                                                        | shape     | unit  |
    |----------------------------------------------------------------|-----------|-------|
    | labels: number of the region of each pixel; -1: of none        | (pixels,) |       |
    | centres: means of position, weighted by value and area         | (k, 2)    | m     |
    | sums: integrals of the image over the regions, S_k             | (k,)      | S m^2 |
    | peaks: largest value in each                                   | (k,)      | S     |
    """

    labels: Int[np.ndarray, " pixels"]
    centres: Float[np.ndarray, "k 2"]
    sums: Float[np.ndarray, " k"]
    peaks: Float[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.peaks)


def find_regions(image: ArrayLike, recon: Pictured, *, level: float = 0.5, least: float = 0.1) -> Regions:
    """Regions of an image that stand out, one per contact; on the host, one image at a time.

    Pixels of at least ``level`` times the largest value are kept and each climbs to the summit
    that its highest neighbour (of eight) leads to. Of two summits whose slopes meet, the lower one
    is joined to the other unless it rises by more than ``least`` times the largest value above
    their pass, so that ripples are not contacts. What does not rise that far above the threshold is
    dropped. The image route of Chen et al. 2025 (arXiv 2503.13036): share a pad's force by ``sums``.

    Args:
        image: (pixels,) S; pixels that miss the sheet are not looked at.
        recon: whose picture it is.
        level: threshold over the largest value, above 0 and below 1.
        least: rise over the largest value, 0 to 1 - ``level``.

    Returns:
        No region where the image is nowhere positive.

    Raises:
        RegionError: if it is not one picture of finite numbers, or a setting is out of range.
    """
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


def _check_settings(level, least):
    if not 0 < level < 1:
        raise RegionError(f"level is {level}; give a number above 0 and below 1")
    if not 0 <= least < 1 - level:
        raise RegionError(f"least is {least}; give 0 or more, and less than 1 - level = {1 - level:.6g}")


def _on_sheet(image, recon):
    if len(recon.shape) != 2:
        raise RegionError("regions need a picture; prepare with basis=Pixels(...)")
    values, areas = np.asarray(image, float), np.asarray(recon.areas)
    if values.shape != areas.shape:
        raise RegionError(f"the image has shape {values.shape}; give one image of {areas.size} pixels")
    values = np.where(areas > 0, values, 0)
    if not np.isfinite(values).all():
        raise RegionError(f"pixel {int(np.argmin(np.isfinite(values)))} of the image is not a finite number")
    return values


def _labels(picture, level, least):
    """Numbers of the regions, the highest first; -1 elsewhere. The picture's largest value is 1."""
    values, kept = picture.ravel(), picture.ravel() >= level
    summit = _climb(picture)
    joined = _join(summit, values, _passes(summit, values, kept.reshape(picture.shape)), least)
    tops = np.unique(joined[kept])
    tops = tops[values[tops] - level > least]
    tops = tops[np.argsort(-values[tops], kind="stable")]
    number = np.full(values.shape, -1)
    number[tops] = np.arange(len(tops))
    return np.where(kept, number[joined], -1)


def _climb(picture):
    """The summit that each pixel's steepest way up ends on, (pixels,)."""
    order = np.argsort(picture.ravel(), kind="stable")  # a rank per pixel leaves no flat ground
    rank = np.empty(order.size, int)
    rank[order] = np.arange(order.size)
    framed = np.pad(rank.reshape(picture.shape), 1, constant_values=-1)
    up = order[np.lib.stride_tricks.sliding_window_view(framed, (3, 3)).max((2, 3)).ravel()]
    while (up[up] != up).any():
        up = up[up]
    return up


def _passes(summit, values, kept):
    """Where the slopes of two summits meet: pixels on either side, (passes, 2), the highest pass first."""
    pixel = np.arange(kept.size).reshape(kept.shape)
    sides = [
        (pixel[:, 1:], pixel[:, :-1]),
        (pixel[1:], pixel[:-1]),
        (pixel[1:, 1:], pixel[:-1, :-1]),
        (pixel[1:, :-1], pixel[:-1, 1:]),
    ]
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in sides])
    pairs = pairs[kept.ravel()[pairs].all(1) & (summit[pairs[:, 0]] != summit[pairs[:, 1]])]
    return pairs[np.argsort(-values[pairs].min(1), kind="stable")]


def _join(summit, values, passes, least):
    """The summit that each pixel belongs to once ripples are joined to what they lie on."""
    into = np.arange(values.size)
    for pair in passes:
        low, high = sorted((_root(into, s) for s in summit[pair]), key=lambda s: values[s])
        if low != high and values[low] - values[pair].min() <= least:
            into[low] = high
    while (into[into] != into).any():
        into = into[into]
    return into[summit]


def _root(into, place):
    while into[place] != place:
        place = into[place]
    return place
