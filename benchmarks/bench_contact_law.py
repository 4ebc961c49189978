"""The force of a contact from its readings alone, before and after the law of contacts is learned.

Single presses of 4 to 25 N anywhere on a skin. Up to 120 of them teach, with pads that tell their forces to 3 % and
0.1 N, by the programs of `learn_layer`: contacts are followed, the gain of the contact layer and the law are learned.
Then other presses rest for half a second, and no pad tells anything. They are followed by the programs of
`apply --track`, once with the gain alone and once with the law as well. The tracker's model error is that of 24 of the
presses, as in a calibration; the untouched sheet is fitted to a frame.

second simulator: skins of `tests/oracles/bench`, which shares no code with the library: protrusions one by one,
Boussinesq's stress, tips of 6 to 30 mm. own scenes: the library's law on another mesh, with an uneven coat and an
uneven contact layer, Gaussian loads of 8 to 18 mm: nothing is to be learned but the gain.

pads: none tells a force, or the one that bears most of the press is dead and the others tell theirs.

Force: median and 90th percentile of the relative error of the sum of all contacts. covered: forces within the 90 %
interval that the standard error states. skins: those on which the law is used.

gain of the layer covered: share of the places, 1 cm apart, at which the true log gain lies in the 90 % interval of the
gain that was learned. On the second simulator the true gain is what the protrusions conduct under a usual press; as its
law has no gain of its own, both gains count less their means over all places.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.calibration.localisation.contact_tracks import ContactTracks
from calib.calibration.localisation.learned.law_lessons import ContactLawLearner
from jaxeit.contacts import LoadSettings
from jaxeit.tracking import (
    ContactLaw,
    LearnedLayer,
    Track,
    Tracker,
    TrackerSettings,
    Tracking,
    fit_depth,
    fit_model_error,
    prepare_tracker,
)

from .force_ways import HELD, LIFTED, PAD_ERROR, SECONDS
from .harness import Question, Run
from .problems import Pressed, fit_model
from .rows import Row, grouped, rounded
from .second_simulator import FORCES, Press, Wear, presses, recorded, relative_gain, true_map

FIRST_SEED = 7300
# Presses after which the force is asked, and skins.
STAGES = {"second simulator": (0, 10, 30, 120), "own scenes": (0, 10, 30, 120)}
SKINS = {"second simulator": 3, "own scenes": 2}
PROBES = 24  # presses that tell the model error
RESTING = 10  # frames of a contact that no pad tells
WIDTHS = (0.008, 0.018)  # m, of Gaussian loads
NONE, DEAD = "none", "one is dead"  # pads that tell forces
INTERVAL = 1.645  # standard errors in half a 90 % interval
GRID = np.stack(np.meshgrid(*2 * [np.linspace(0.02, 0.18, 17)]), -1).reshape(-1, 2)  # m, where the gain is judged
USUAL = Press(np.array([[0.1, 0.1]]), np.array([8.0]), 0.02)  # N, m


class Skin(NamedTuple):
    """Presses on a skin: changes of frames (n, readings) V, forces (n,) and forces on pads (n, pads) N; noise of the
    readings (readings,) V; an untouched frame (readings,) V; the true log gain at the places of `GRID`, and whether a
    constant of it is not known."""

    changes: np.ndarray
    forces: np.ndarray
    pads: np.ndarray
    noise: np.ndarray
    untouched: np.ndarray
    gain: np.ndarray
    relative: bool


def second_simulator(model: je.Model, seed: int, count: int) -> Skin:
    """A skin that shares no code with the library."""
    rng = np.random.default_rng([seed, 17])
    given = presses(rng, count)
    found = recorded(seed, given, Wear())
    blank = found.blank(rng)
    image = je.prepare(model, basis=je.Pixels(20), noise=found.std)
    masks, centres = np.asarray(je.pad_masks(je.load_skin("testbed"), image).weights), np.asarray(image.centres)
    pads = np.array([true_map(press, centres) for press in given]) @ masks.T
    forces = np.array([press.forces.sum() for press in given])
    return Skin(found.change, forces, pads, found.std, blank, relative_gain(seed, Wear(), GRID, USUAL), True)


def own_scene(model: je.Model, seed: int, count: int) -> Skin:
    """A skin whose contacts follow the law that the tracker takes for granted."""
    rng, skin, gain = np.random.default_rng([seed, 23]), je.load_skin("testbed"), je.effects.ContactGain(seed=seed)
    effects = (je.effects.CoatingNonUniformity(seed=seed), gain, je.effects.ContactPiezoresistance())
    true = je.discretise(je.Scene(skin, effects), je.Fidelity.standard())
    v0 = np.asarray(je.forward(true, je.conductivity(true)))
    places, forces = rng.uniform(0.02, 0.18, (count, 2)), rng.uniform(*FORCES, count)
    spread = [gaussian(true, *one) for one in zip(places, rng.uniform(*WIDTHS, count), strict=True)]
    volts = [je.forward(true, je.conductivity(true, f * one)) for f, one in zip(forces, spread, strict=True)]
    pixels = je.Pixels(20).on(true)
    on_pixels = np.array([pixels.restrict(f * one * true.areas) for f, one in zip(forces, spread, strict=True)])
    pads = on_pixels @ np.asarray(je.pad_masks(skin, pixels).weights).T
    found, field = Pressed.of(v0, np.array(volts) - v0), gain.laid(jnp.asarray(GRID)).field
    return Skin(found.change, forces, pads, found.std, found.blank(rng), np.asarray(gain.std * field), False)


def gaussian(model: je.Model, place: np.ndarray, width: float) -> np.ndarray:
    """Pressure of a Gaussian load of one newton on the elements, Pa."""
    square = ((np.asarray(model.centroids) - place) ** 2).sum(1)
    return np.exp(-0.5 * square / width**2) / (2 * np.pi * width**2)


SCENES: dict[str, Callable[[je.Model, int, int], Skin]] = {
    "second simulator": second_simulator,
    "own scenes": own_scene,
}


def as_presses_tell(prepare: Callable[..., Tracker], *presses: np.ndarray) -> Tracker:
    """The tracker whose loads spread and whose model errs as presses tell, as `live` prepares it."""
    tracker = prepare()
    if depth := fit_depth(tracker, *presses):
        tracker = prepare(TrackerSettings(loads=LoadSettings(depth=depth)))
    return fit_model_error(tracker, *presses)


class Session:
    """A skin in use: presses that teach, and others that are told by their readings alone."""

    def __init__(self, model: je.Model, skin: Skin, seed: int, probes: int):
        self.skin, self.rng = skin, np.random.default_rng([seed, 29])
        prepare = partial(prepare_tracker, model, je.load_skin("testbed"), noise=skin.noise, untouched=skin.untouched)
        forces, errors = self.told(skin.pads[:probes])
        self.tracker: Tracker = as_presses_tell(prepare, self.noisy(skin.changes[:probes]), forces, errors)

    def noisy(self, changes: np.ndarray) -> np.ndarray:
        """Frames with their noise."""
        return np.asarray(changes + self.skin.noise * self.rng.normal(size=changes.shape))

    def told(self, exact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What pads tell, N, and their errors."""
        forces = exact + np.hypot(PAD_ERROR[0] * exact, PAD_ERROR[1]) * self.rng.normal(size=exact.shape)
        return forces, np.hypot(PAD_ERROR[0] * np.maximum(forces, 0), PAD_ERROR[1])

    def taught(self, stages: tuple[int, ...]) -> Iterator[tuple[int, LearnedLayer, ContactLaw]]:
        """Gain and law after some presses, which follow one another in one session."""
        lessons = ContactLawLearner(self.tracker, None, None)
        tracks, level = ContactTracks(self.tracker, smooth=False, watch=lessons), np.repeat([1.0, 0.0], [HELD, LIFTED])
        for number in range(max(stages) + 1):
            if number in stages:
                yield number, tracks.learned(), lessons.law()
            time = round(1e9 * SECONDS) * (len(level) * number + np.arange(len(level)))
            change = self.noisy(level[:, None] * self.skin.changes[number])
            tracks.add(time, change, *self.told(level[:, None] * self.skin.pads[number]))

    def alone(
        self, number: int, layer: LearnedLayer, law: ContactLaw, pads: str
    ) -> tuple[tuple[Track, ...], tuple[Track, ...]]:
        """The contacts of a press that some pads do not tell, without the law and with it."""
        seen: list[Tracking] = []
        tracks = ContactTracks(
            self.tracker, smooth=False, layer=layer, watch=lambda now, change, errors: seen.append(now)
        )
        exact, change = (np.tile(a[number], (RESTING, 1)) for a in (self.skin.pads, self.skin.changes))
        silent = np.ones(exact.shape[1], bool) if pads == NONE else np.arange(exact.shape[1]) == np.argmax(exact[0])
        forces, errors = (np.where(silent, np.nan, a) for a in self.told(exact))
        tracks.add(round(1e9 * SECONDS) * np.arange(RESTING), self.noisy(change), forces, errors)
        found = seen[-1].tracks
        return found, law.without_pads(found, self.tracker.told_by_pads(found, errors[-1]))


def places_covered(layer: LearnedLayer, skin: Skin) -> float:
    """Share of the places at which the true gain lies in its 90 % interval."""
    modes, true = layer.field.modes_at(GRID), skin.gain
    if skin.relative:
        modes, true = modes - modes.mean(0), true - true.mean()
    deviation = np.sqrt(((modes @ layer.true_covariance) * modes).sum(1))
    return float(np.mean(np.abs(modes @ layer.mean - true) < INTERVAL * deviation))


def judged(tracks: tuple[Track, ...], true: float) -> Row:
    """What is right of the sum of the contacts' forces; without any, all of it is missed."""
    force = sum(one.force for one in tracks)
    if not force:
        return {"error": 1.0, "covered": False}
    error = np.linalg.norm([one.force * one.log_force_error for one in tracks]) / force
    return {"error": abs(force / true - 1), "covered": bool(abs(np.log(force / true)) < INTERVAL * error)}


def one_scene(run: Run, scene: str) -> Iterator[Row]:
    """Errors of force on skins of one kind."""
    (stages, given), rows = run.sizes((STAGES[scene], 15), ((0, 2), 2)), []
    model = fit_model()
    for seed in range(FIRST_SEED, FIRST_SEED + (1 if run.smoke else SKINS[scene])):
        skin = SCENES[scene](model, seed, max(stages) + 1 + given)
        session = Session(model, skin, seed, min(PROBES, max(stages)))
        for number, layer, law in session.taught(stages):
            about = {"presses": number, "seed": seed, "used": law.is_better, "layer": places_covered(layer, skin)}
            for press, pads in product(range(max(stages) + 1, len(skin.forces)), (NONE, DEAD)):
                for way, each in zip(("gain", "law"), session.alone(press, layer, law, pads), strict=True):
                    rows.append(about | {"way": way, "pads": pads} | judged(each, skin.forces[press]))
        depth = f"{1e3 * session.tracker.field.depth:.1f} mm"
        print(f"{scene}, skin {seed}: depth {depth}, {law.mean.round(2)}, evidence {law.evidence:.1f}", flush=True)
    yield {
        scene: [
            {"skin": scene, "pads": pads} | summary(number, mine)
            for pads, of_pads in grouped(rows, "pads").items()
            for number, mine in grouped(of_pads, "presses").items()
        ]
    }


def summary(presses: int, rows: list[Row]) -> Row:
    """Both ways after so many presses."""
    found: Row = {"presses": presses, "frames": len(rows) // 2, "skins": len({row["seed"] for row in rows})}
    for way, mine in grouped(rows, "way").items():
        error, covered = (np.array([row[name] for row in mine]) for name in ("error", "covered"))
        figures = {"error": np.median(error), "error 90": np.quantile(error, 0.9), "covered": covered.mean()}
        found |= rounded({f"{way} {name}": value for name, value in figures.items()})
    found |= rounded({"layer covered": np.mean([row["layer"] for row in rows])})
    return found | {"used": len({row["seed"] for row in rows if row["used"]})}


main = Question("contact_law", __doc__, {scene.split()[0]: partial(one_scene, scene=scene) for scene in SCENES})

if __name__ == "__main__":
    main()
