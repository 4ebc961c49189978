"""All ways to tell the forces on a skin of the second simulator: by physics, by the regressor, and by both."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.contacts import Loads
from jaxeit.tracking import LearnedLayer, Tracker, prepare_tracker

from .regressor import Adapted, Belief
from .second_simulator import Wear, pairs, presses, recorded, true_map

STAGES = (0, 30, 120)  # presses of ordinary use, after which the ways are asked
USUAL = 0.012  # m, width of a load
HELD, LIFTED = 3, 2  # frames of a press that is followed, and those without contact after it
SECONDS = 0.05  # a frame
PAD_ERROR = (0.03, 0.1)  # relative, and N
LEAST_PEAK, FLOOR = 0.4, 1e-3  # of the highest: peaks that count, and pixels whose logarithm counts


class Answer(NamedTuple):
    """Force map (pixels,) N, and places (n, 2) m."""

    map: np.ndarray
    places: np.ndarray


# From a frame (readings,) V and forces on the pads (pads,) N, NaN: not known, to an answer.
Way = Callable[[np.ndarray, np.ndarray], Answer]


def peaks(image: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Places (n, 2) m of the maxima of an image, the highest first: vertices of parabolas through the logarithms of the
    pixels around, which are exact for a Gaussian."""
    side = round(len(image) ** 0.5)
    around = np.pad(image.reshape(side, side), 1, constant_values=-np.inf)
    near = [around[i : i + side, j : j + side].ravel() for i in range(3) for j in range(3)]
    tops = np.flatnonzero((image >= np.max(near, 0)) & (image > LEAST_PEAK * image.max()))
    logs = np.log(np.maximum(image, FLOOR * image.max())).reshape(side, side)
    pitch = 2 * centres.min()
    found = [
        [_vertex(logs[row], column), _vertex(logs[:, column], row)]
        for row, column in zip(*divmod(tops, side), strict=True)
    ]
    return np.clip((np.array(found) + 0.5) * pitch, 0, side * pitch)[np.argsort(-image[tops])]


def _vertex(logs: np.ndarray, top: int) -> float:
    """Where along a line of pixels the parabola through three about the highest has its vertex, in pixels."""
    middle = min(max(top, 1), len(logs) - 2)
    low, own, high = logs[middle - 1 : middle + 2]
    bend = low - 2 * own + high
    return middle + (float(np.clip(0.5 * (low - high) / bend, -1.5, 1.5)) if bend < 0 else 0.0)


class Bench:
    """A skin of the second simulator, and all ways to tell its forces."""

    def __init__(self, adapted: Adapted, model: je.Model, seed: int, wear: Wear, count: tuple[int, int, int]):
        self.adapted, self.rng, rng = adapted, np.random.default_rng([seed, 17]), np.random.default_rng(seed)
        self.used = presses(rng, count[0])
        self.given = presses(rng, count[1], wear.tip) + pairs(rng, count[2])
        found = recorded(seed, [*self.used, *self.given], wear)
        self.changes, self.frames = np.split(found.change, [len(self.used)])
        self.noise = found.std
        self.frames = self.frames + self.noise * self.rng.normal(size=self.frames.shape)
        self.truth = np.array([true_map(press, adapted.centres) for press in self.given])
        self.pads = self.told(self.truth)
        sheet = je.fit_background(model, found.blank(self.rng))
        skin, options = je.load_skin("testbed"), {"noise": self.noise, "sigma": sheet}
        self.image = je.prepare(model, basis=je.Pixels(20), **options)
        self.masks = je.pad_masks(skin, self.image)
        self.fitter, self.finder = (f(model, **options) for f in (je.contacts.prepare_loads, je.prepare_contacts))
        self.tracker: Tracker = prepare_tracker(model, skin, **options)
        self.proposal = je.contacts.load_proposal("testbed")
        self._searched: dict[bytes, Loads] = {}

    def told(self, maps: np.ndarray) -> np.ndarray:
        """What the pads tell of force maps (n, pixels): forces (n, pads) N."""
        exact = maps @ self.adapted.masks.T
        return exact + np.hypot(PAD_ERROR[0] * exact, PAD_ERROR[1]) * self.rng.normal(size=exact.shape)

    # --- what ordinary use tells

    def beliefs(self, known: bool) -> dict[int, Belief]:
        """The belief about the regressor's last layer after some presses, whose places are known or not."""
        now, found = self.adapted.prior, {0: self.adapted.prior}
        for number, press in enumerate(self.used):
            frame = self.changes[number] + self.noise * self.rng.normal(size=self.noise.size)
            (forces,) = self.told(true_map(press, self.adapted.centres)[None])
            # The centre of a map differs from the place where the sheet ends: that of a usual load is compared.
            shape = self._drawn(press.places, np.array([USUAL]), np.ones(1))
            now = self.adapted.told(now, frame, forces, shape @ self.adapted.centres if known else None)
            found |= {number + 1: now} if number + 1 in STAGES else {}
        return found

    def layers(self) -> dict[int, LearnedLayer]:
        """What the tracker has learned of the contact layer after some presses."""
        now = LearnedLayer.unknown(self.tracker.field)
        found = {0: now}
        for number in range(len(self.used)):
            now = self.learned_from(now, number)
            found |= {number + 1: now} if number + 1 in STAGES else {}
        return found

    def learned_from(self, layer: LearnedLayer, number: int) -> LearnedLayer:
        """What is known of the contact layer after one of the presses of ordinary use."""
        now, exact = self.tracker.start(layer), true_map(self.used[number], self.adapted.centres)
        for level in np.repeat([1.0, 0.0], [HELD, LIFTED]):
            frame = level * self.changes[number] + self.noise * self.rng.normal(size=self.noise.size)
            (forces,) = self.told(level * exact[None])
            now = self.tracker.step(now, frame, SECONDS, forces, self._pad_errors(forces))
        return self.tracker.learned(now)

    def _pad_errors(self, forces: np.ndarray) -> np.ndarray:
        return np.hypot(PAD_ERROR[0] * np.maximum(np.nan_to_num(forces), 0), PAD_ERROR[1])

    # --- ways

    def fused(self, shape: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """A map (pixels,) N whose parts on the pads are made to sum to what these tell."""
        own = self.adapted.masks @ shape
        density = jnp.asarray(shape / np.asarray(self.masks.areas))
        return np.asarray(je.fuse(density, self.masks, jnp.asarray(np.where(np.isfinite(forces), forces, own))).force)

    def by_image(self, frame: np.ndarray, forces: np.ndarray) -> Answer:
        image = self.image(frame)
        return Answer(
            np.asarray(je.fuse(image, self.masks, forces).force), peaks(np.asarray(image), self.adapted.centres)
        )

    def by_search(self, frame: np.ndarray, forces: np.ndarray) -> Answer:
        """Loads of a search, which does not see the pads: each frame is searched once."""
        if frame.tobytes() not in self._searched:
            self._searched[frame.tobytes()] = self.fitter(frame, self.finder(frame))
        return self._of_loads(self._searched[frame.tobytes()], forces)

    def by_proposal(self, frame: np.ndarray, forces: np.ndarray) -> Answer:
        """Loads as `jaxeit apply --loads` fits them."""
        return self._of_loads(self.fitter.refine(frame, self.proposal(frame, forces), self.finder(frame)), forces)

    def _of_loads(self, loads: Loads, forces: np.ndarray) -> Answer:
        best = loads.best or loads.one
        shown = self._drawn(np.asarray(best.position), np.asarray(best.width), np.asarray(best.force))
        return Answer(self.fused(shown, forces), np.asarray(best.position))

    def by_tracks(self, layer: LearnedLayer, frame: np.ndarray, forces: np.ndarray) -> Answer:
        now = self.tracker.step(self.tracker.start(layer), frame, SECONDS, forces, self._pad_errors(forces))
        each = now.tracks
        if not each:
            return Answer(np.zeros(len(self.adapted.centres)), np.zeros((0, 2)))
        places = np.array([t.position for t in each])
        shown = self._drawn(places, np.array([t.width for t in each]), np.array([t.force for t in each]))
        return Answer(self.fused(shown, forces), places)

    def by_network(self, belief: Belief, frame: np.ndarray, forces: np.ndarray, *, fuses: bool = False) -> Answer:
        (found,) = self.adapted.maps(belief, frame[None], forces[None])
        return Answer(self.fused(found, forces) if fuses else found, peaks(found, self.adapted.centres))

    def _drawn(self, places: np.ndarray, widths: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Gaussian loads on the pixels, N."""
        square = ((self.adapted.centres[:, None] - places) ** 2).sum(2)
        bumps = np.exp(-0.5 * square / np.maximum(widths, 5e-3) ** 2)
        return (bumps / bumps.sum(0)) @ forces

    def ways(self) -> dict[str, Way]:
        """All ways by name."""
        usual, known, layers = self.beliefs(False), self.beliefs(True), self.layers()
        most = max(usual)

        return (
            {"physics: image fused with the pads": self.by_image, "physics: loads fitted": self.by_search}
            | {
                f"physics: contacts followed, {n} presses": partial(self.by_tracks, layer)
                for n, layer in layers.items()
            }
            | {f"learned: regressor, {n} presses": partial(self.by_network, belief) for n, belief in usual.items()}
            | {f"learned: regressor, {most} presses at known places": partial(self.by_network, known[most])}
            | {
                f"both: regressor fused with the pads, {n} presses": partial(self.by_network, usual[n], fuses=True)
                for n in (0, most)
            }
            | {"both: loads fitted from a proposal": self.by_proposal}
        )
