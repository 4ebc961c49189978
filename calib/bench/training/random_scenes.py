"""Random contacts on a skin: none to three at a time, of drawn places, footprints and forces."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

import jaxeit as je

from ..bench import BenchError

MAX_CONTACTS = 3
TIPS = 12  # of a frame, shared by its contacts: 12, 6 or 4 each
SUM_TOLERANCE = 1e-9  # of probabilities
# Ranges of `RandomScenes`, and the least value of each.
RANGES = {"force": 0.0, "size": 0.0, "length": 0.0, "apart": 0.0, "hold": 0.0, "peak": 1.0, "strength": 0.0}
STRENGTHS = ("std", "fraction", "width")
"""Fields of effects that `RandomScenes.strength` multiplies: deviations, crosstalk, how far a pad spreads a load."""


class Footprint(IntEnum):
    """How the tips of one contact are arranged."""

    ABSENT = 0  # there is no contact
    TIP = 1  # one tip
    DISC = 2  # tips all over a disc
    RING = 3  # tips along a circle
    EDGE = 4  # tips along a line


@dataclass(frozen=True)
class RandomScenes:
    """Distributions that the contacts of a frame are drawn from.

    A contact is a few tips of the scene's bench that share its force: at one place, on a disc, on a ring or along an
    edge. Each tip presses as the scene says, so that `jaxeit.effects.LoadSpreading` makes a Gaussian of each.

    | field                                                                        | shape | unit |
    |------------------------------------------------------------------------------|-------|------|
    | counts: probabilities of 0, 1, 2 and 3 contacts                              | (4,)  | 1    |
    | footprints: probabilities of tip, disc, ring and edge                        | (4,)  | 1    |
    | force of a contact: lowest and highest; its logarithm is uniform             | (2,)  | N    |
    | size: radius of a disc or ring, half the length of an edge; uniform          | (2,)  | m    |
    | together: probabilities of footprints of contacts that are not alone, if not | (4,)  | 1    |
    |   as `footprints`                                                            |       |      |
    | length: half the length of an edge, if not as `size`; uniform                | (2,)  | m    |
    | near: probability that each further contact is near the first                | ()    | 1    |
    | apart: distance of these from the first; uniform                             | (2,)  | m    |
    | hold: time since the load is constant; its logarithm is uniform              | (2,)  | s    |
    | peak: highest load before the hold over that of the hold, in half the frames | (2,)  | 1    |
    | strength: factors of the `STRENGTHS` of a skin's effects; log-uniform         | (2,)  | 1    |
    | misplaced: standard deviation of each coordinate of a skin's electrodes      | ()    | m    |

    Places are uniform over the sheet, directions of edges uniform. `hold` and `peak` matter only if the scene has an
    effect with memory: the load rises to the peak in half the hold time, falls in the same time, and is then held.

    Raises:
        BenchError: for probabilities that do not sum to 1, or an empty or impossible range.

    Example:
        print([arrangement.name for arrangement in calib.bench.Footprint])  # tip, disc, ring and edge
        edges_only = calib.bench.RandomScenes(
            counts=(0.0, 1.0, 0.0, 0.0), footprints=(0.0, 0.0, 0.0, 1.0), force=(1.0, 20.0)
        )
    """

    counts: tuple[float, float, float, float] = (0.1, 0.5, 0.25, 0.15)
    footprints: tuple[float, float, float, float] = (0.4, 0.2, 0.2, 0.2)
    force: tuple[float, float] = (0.5, 30.0)
    size: tuple[float, float] = (0.003, 0.02)
    hold: tuple[float, float] = (0.1, 10.0)
    peak: tuple[float, float] = (1.0, 2.0)
    together: tuple[float, float, float, float] | None = None
    length: tuple[float, float] | None = None
    near: float = 0.0
    apart: tuple[float, float] = (0.015, 0.06)
    strength: tuple[float, float] = (1.0, 1.0)
    misplaced: float = 0.0

    def __post_init__(self) -> None:
        for name in ("counts", "footprints", "together"):
            values = np.asarray(getattr(self, name) or self.footprints, float)
            if values.shape != (4,) or not (values >= 0).all() or abs(values.sum() - 1) > SUM_TOLERANCE:
                raise BenchError(f"RandomScenes: {name} is {getattr(self, name)}; give 4 probabilities whose sum is 1")
        for name, least in RANGES.items():
            low, high = getattr(self, name) or (1.0, 1.0)
            if not (least <= low <= high < np.inf) or low <= 0:
                what = "above zero" if least == 0 else f"from {least:g}"
                raise BenchError(f"RandomScenes: {name} is {getattr(self, name)}; give a range {what}, lowest first")
        if not (0 <= self.near <= 1 and 0 <= self.misplaced < np.inf):
            what = f"near is {self.near}, misplaced is {self.misplaced}"
            raise BenchError(f"RandomScenes: {what}; give a probability, and a length in m")


class DrawnContacts(NamedTuple):
    """Contacts of some frames; a contact that is absent has zeros.

    | field                                                 | shape                 | unit |
    |-------------------------------------------------------|-----------------------|------|
    | number of contacts                                    | (frames,)             | 1    |
    | place of the middle of each                           | (frames, contacts, 2) | m    |
    | force                                                 | (frames, contacts)    | N    |
    | footprint: a `Footprint`                              | (frames, contacts)    |      |
    | size: radius of disc or ring, half length of an edge  | (frames, contacts)    | m    |
    | angle of an edge against x, of the tips of the others | (frames, contacts)    | rad  |
    | hold: time since the load is constant                 | (frames,)             | s    |
    | peak: highest load before the hold over that of it    | (frames,)             | 1    |
    """

    number: Int[np.ndarray, " frames"]
    place: Float[np.ndarray, "frames contacts 2"]
    force: Float[np.ndarray, "frames contacts"]
    footprint: Int[np.ndarray, "frames contacts"]
    size: Float[np.ndarray, "frames contacts"]
    angle: Float[np.ndarray, "frames contacts"]
    hold: Float[np.ndarray, " frames"]
    peak: Float[np.ndarray, " frames"]


class Tips(NamedTuple):
    """The tips of some frames.

    | field                                 | shape             | unit |
    |---------------------------------------|-------------------|------|
    | place                                 | (frames, tips, 2) | m    |
    | contact: number of the tip's contact  | (frames, tips)    |      |
    | share of the force of that contact    | (frames, tips)    | 1    |
    """

    place: Float[np.ndarray, "frames tips 2"]
    contact: Int[np.ndarray, "frames tips"]
    share: Float[np.ndarray, "frames tips"]


def draw_contacts(
    scenes: RandomScenes, domain: je.geometry.Domain, frames: int, rng: np.random.Generator
) -> DrawnContacts:
    """Draw the contacts of ``frames`` frames on a sheet."""
    shape = (frames, MAX_CONTACTS)
    number = rng.choice(MAX_CONTACTS + 1, frames, p=scenes.counts)
    footprint = 1 + rng.choice(4, shape, p=scenes.footprints)
    place = _places(domain, frames * MAX_CONTACTS, rng).reshape(*shape, 2)
    size = np.where(footprint == Footprint.TIP, 0, rng.uniform(*scenes.size, shape))
    there = np.arange(MAX_CONTACTS) < number[:, None]
    drawn = DrawnContacts(
        number=number,
        place=np.where(there[..., None], place, 0),
        force=np.where(there, _log_uniform(scenes.force, shape, rng), 0),
        footprint=np.where(there, footprint, Footprint.ABSENT),
        size=np.where(there, size, 0),
        angle=np.where(there, rng.uniform(0, np.pi, shape), 0),
        hold=_log_uniform(scenes.hold, (frames,), rng),
        peak=np.where(rng.random(frames) < 0.5, rng.uniform(*scenes.peak, frames), 1),
    )
    # What follows draws nothing with the default scenes, whose frames are those of earlier versions.
    if scenes.together is not None:
        several = there & (number > 1)[:, None]
        footprint = np.where(several, 1 + rng.choice(4, shape, p=scenes.together), drawn.footprint)
        size = np.where(several, rng.uniform(*scenes.size, shape), drawn.size)
        drawn = drawn._replace(footprint=footprint, size=np.where(footprint == Footprint.TIP, 0, size))
    if scenes.length is not None:
        length = rng.uniform(*scenes.length, shape)
        drawn = drawn._replace(size=np.where(drawn.footprint == Footprint.EDGE, length, drawn.size))
    return _crowded(scenes, domain, drawn, rng) if scenes.near else drawn


def _crowded(
    scenes: RandomScenes, domain: je.geometry.Domain, drawn: DrawnContacts, rng: np.random.Generator
) -> DrawnContacts:
    """Some further contacts near the first, where that is on the sheet."""
    shape = drawn.force.shape
    turn, distance = rng.uniform(0, 2 * np.pi, shape), rng.uniform(*scenes.apart, shape)
    place = drawn.place[:, :1] + distance[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    moved = (rng.random(shape) < scenes.near) & (drawn.footprint > Footprint.ABSENT)
    moved &= domain.contains(place.reshape(-1, 2)).reshape(shape)
    moved[:, 0] = False
    return drawn._replace(place=np.where(moved[..., None], place, drawn.place))


def _log_uniform(
    limits: tuple[float, float], shape: tuple[int, ...], rng: np.random.Generator
) -> Float[np.ndarray, "..."]:
    low, high = np.log(limits)
    return np.exp(rng.uniform(low, high, shape))


def _places(domain: je.geometry.Domain, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 2"]:
    """Places that are uniform over a sheet, m: those of its bounding box that lie on it."""
    low, high = (np.asarray(corner, float) for corner in domain.bounds)
    found = np.empty((0, 2))
    while len(found) < count:
        tried = rng.uniform(low, high, (2 * count, 2))
        found = np.concatenate([found, tried[domain.contains(tried)]])
    return found[:count]


def arrange_tips(contacts: DrawnContacts) -> Tips:
    """The tips of each frame, in footprints about the places of its contacts.

    The tips of a ring or an edge have even distances. A disc has half of its tips at 0.5 and half at 0.87 of its
    radius, the root mean squares of two parts of equal area. The mean of the tips is the place of the contact; their
    mean square distance from it is that of a disc or ring, and less by a share of 1 / n^2 than that of an edge of n
    tips.
    """
    each = TIPS // np.maximum(contacts.number, 1)[:, None]
    contact, tip = np.arange(TIPS) // each, np.arange(TIPS) % each
    footprint, size, angle = (
        np.take_along_axis(values, contact, 1) for values in (contacts.footprint, contacts.size, contacts.angle)
    )
    half = each // 2
    outer = tip >= half
    ring = 2 * np.pi * tip / each
    disc = 2 * np.pi * (tip % half) / half + np.where(outer, np.pi / half, 0)
    turn = angle + np.select([footprint == Footprint.RING, footprint == Footprint.DISC], [ring, disc], 0)
    along = (2 * tip + 1) / each - 1
    disc_radius = np.sqrt(np.where(outer, 0.75, 0.25))
    radius = size * np.select([footprint == Footprint.DISC, footprint == Footprint.EDGE], [disc_radius, along], 1)
    offset = radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    middle = np.take_along_axis(contacts.place, contact[..., None], 1)
    return Tips(middle + offset, contact, np.broadcast_to(1 / each, contact.shape))
