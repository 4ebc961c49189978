"""How large the pads of a skin should be: errors of the force of one contact and of each of two, by the number of pads.

The testbed's sheet over a grid of n by n pads without gaps. Tips of 20 mm press with 5 to 15 N, one or two at once,
40 mm or more apart, 20 mm or more from the rim, on sheets whose coat (15 %) and contact layer (12 %) are uneven; they
are simulated on another mesh. Contacts are fitted to readings with noise 60 dB below them, with the coat fitted to the
untouched frames; they are the same whatever the pads.

A pad bears the part of each load, spread to a Gaussian of 12 mm, that lies on it, and its pressure is that over its
area. The force of a pad is that pressure times the area, with the sensor's stated error (86 Pa, normal) or without: the
error in newtons is in proportion to the area. Forces within a pad are split by the fitted contacts
(`je.fusion.contact_shares`); a pad with less than a hundredth of a contact counts as at rest. Neither an error of the
pads' curves nor a seam between pads is included. Of pairs, those count in which both contacts are found.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.special import erf

import jaxeit as je
from jaxeit.model.bases import BasisMap

from .harness import Question, Run
from .problems import matched, pressed, uneven
from .rows import Row

GRIDS = (1, 2, 3, 4)
SKINS, PRESSES, SEED = 3, 60, 41  # sheets, and presses of each kind on each of them
LEAST_ON_PAD = 0.01  # part of a contact, below which a pad counts as one at rest
FORCES, APART, MARGIN, SPREAD = (5.0, 15.0), 0.04, 0.02, 0.012  # N, m, m, m


def grid(side: int, skin: je.Skin) -> je.Skin:
    """The skin over ``side`` by ``side`` equal pads."""
    (x0, y0), (x1, y1) = skin.domain.bounds
    x, y = np.linspace(x0, x1, side + 1), np.linspace(y0, y1, side + 1)
    corners = [(x[c], x[c + 1], y[r], y[r + 1]) for r in range(side) for c in range(side)]
    pads = tuple(je.Pad(str(k), np.array([[a, c], [b, c], [b, d], [a, d]])) for k, (a, b, c, d) in enumerate(corners))
    return replace(skin, pads=pads)


def borne(skin: je.Skin, places: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Force on each pad, (presses, pads) N, of Gaussian loads (presses, k, 2) that lie on the sheet as a whole."""

    def inside(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        ends = [erf((end - places[..., None, :]) / (np.sqrt(2) * SPREAD)) for end in (low, high)]
        return np.asarray(np.prod(0.5 * (ends[1] - ends[0]), -1))

    low, high = (np.array([end(pad.outline, 0) for pad in skin.pads]) for end in (np.min, np.max))
    share = inside(low, high) / inside(*(np.asarray(bound)[None] for bound in skin.domain.bounds))
    return np.einsum("pk,pkn->pn", forces, share)


class Presses(NamedTuple):
    """Presses of one sheet, one contact at once or two, and the contacts found in their frames.

    | meaning                        | shape           | unit |
    |--------------------------------|-----------------|------|
    | places                         | (presses, 2, 2) | m    |
    | forces; zero for no contact    | (presses, 2)    | N    |
    | found                          |                 |      |
    """

    places: np.ndarray
    forces: np.ndarray
    found: je.contacts.Contacts


def presses(seed: int, count: int, smoke: bool) -> tuple[je.Model, Presses]:
    """As many single contacts as pairs."""
    rng = np.random.default_rng([SEED, seed])
    skin = je.load_skin("testbed")
    low, high = (np.asarray(bound) for bound in skin.domain.bounds)
    places = np.empty((0, 2, 2))
    while len(places) < 2 * count:
        drawn = rng.uniform(low + MARGIN, high - MARGIN, (2 * count, 2, 2))
        places = np.concatenate([places, drawn[np.linalg.norm(drawn[:, 0] - drawn[:, 1], axis=1) > APART]])
    places, forces = places[: 2 * count], rng.uniform(*FORCES, (2 * count, 2))
    forces[:count, 1] = 0
    seen = pressed(uneven(seed), places, forces, 0.06 if smoke else 0.026, SPREAD)
    blank, frames = seen.frames(rng)
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    settings = je.contacts.ContactSettings(most=2, columns=21 if smoke else 41)
    noise = np.full(blank.size, seen.noise)
    finder = je.prepare_contacts(model, settings, noise=noise, sigma=je.fit_background(model, blank))
    return model, Presses(places, forces, finder(jnp.asarray(frames)))


def shared(skin: je.Skin, image: BasisMap, made: Presses, error: float) -> np.ndarray:
    """Errors of the force of each contact, (presses, 2) N, with sensors of this error, Pa; NaN where none is found."""
    areas = np.array([pad.area for pad in skin.pads])
    rng = np.random.default_rng([SEED, len(areas)])
    force = borne(skin, made.places, made.forces)
    force = force + error * areas * rng.normal(size=force.shape)
    masks, found = je.pad_masks(skin, image), made.found
    parts = je.fusion.contact_shares(found.position, found.width, found.amplitude, image.centres, masks)
    on = np.asarray(parts.lies).max(1) > LEAST_ON_PAD
    told = np.einsum("pkn,pn->pk", np.asarray(parts.share), np.where(on, force, 0))
    out = np.full(made.forces.shape, np.nan)
    for row, (there, place, truth) in enumerate(zip(found.present, found.position, made.forces, strict=True)):
        own = np.asarray(place)[np.asarray(there)]
        if truth[1] == 0 and len(own):
            out[row, 0] = told[row].sum() - truth[0]
        elif truth[1] and matched(own, made.places[row]):
            away = np.linalg.norm(own[:, None] - made.places[row], axis=-1)
            out[row] = told[row, np.argmin(away, 0)] - truth
    return out


def measure(run: Run) -> Iterator[Row]:
    """A row for each number of pads."""
    count = 4 if run.smoke else PRESSES
    made = [presses(seed, count, run.smoke) for seed in range(1 if run.smoke else SKINS)]
    skin, image = je.load_skin("testbed"), je.Pixels(40).on(made[0][0])
    yield {"presses": 2 * count * len(made), "rows": []}
    for side in run.sizes(GRIDS, (2,)):
        over = grid(side, skin)
        row: Row = {"pads": side**2, "side_mm": 1e3 * float(np.ptp(over.pads[0].outline[:, 0]))}
        for name, error in {"exact": 0.0, "sensor": skin.pressure_sensor.accuracy}.items():
            errors = np.concatenate([shared(over, image, one, error) for _, one in made])
            single = np.tile(np.arange(2 * count) < count, len(made))
            row |= {f"one_{name}_n": float(np.sqrt(np.nanmean(errors[single, 0] ** 2)))}
            row |= {f"two_{name}_n": float(np.sqrt(np.nanmean(errors[~single] ** 2)))}
        apart = [
            np.argmax(borne(over, m.places[:, [k]], np.ones((len(m.places), 1))), 1) for _, m in made for k in (0, 1)
        ]
        row["alone"] = float(np.mean(np.concatenate(apart[::2])[~single] != np.concatenate(apart[1::2])[~single]))
        row["found"] = float(np.mean(np.isfinite(errors[~single, 0])))
        yield {"rows": [row]}


main = Question("pads", __doc__, {"rows": measure})

if __name__ == "__main__":
    main()
