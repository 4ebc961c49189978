"""What a learned proposal is worth: fits alone, the network alone, and both, on frames that another simulator made.

Frames come from the second simulator (`tests/oracles/bench`), which shares no code with the first, on skins of fresh
seeds: protrusions one by one, Boussinesq's stress, tips of 12 mm, an uneven coat, noise 60 dB below the readings, 20 N.
The network has the shipped numbers for the testbed and sees neither the untouched frame nor the pads. Fits know the
sheet from one untouched frame.

ways: single tips, equal pairs at 20 and 30 mm, edges of 40 and 60 mm, each with its error of place. "told": the most
probable kind is the true one, and for two both places are nearer than half their distance. "several": more than one
load is the most probable. "surprise": mean of minus the log probability of the true kind, at most that of 1e-6.

reliability: how often the kinds that network and fits state are the true ones.

held_out: figures of the shipped numbers on skins that their training held out.

unlike: frames from outside of the training, and how many of them are announced.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxeit as je
from calib.calibration.localisation.load_windows import FIDELITY
from jaxeit.contacts import LoadFitter, LoadKind, Loads, Proposal
from tests.oracles.bench import contact
from tests.oracles.bench.mesh import make_mesh
from tests.oracles.bench.session import coating, transfer_frames
from tests.oracles.bench.sheet import make_sheet, readings
from tests.oracles.bench.skin import read_skin

from .bench_loads import Touch, reliability, touches
from .clock import seconds
from .harness import Question, Run
from .problems import BLANKS, matched
from .rows import Row, grouped

NAMES = ("one", "two, 1:1, 20 mm", "two, 1:1, 30 mm", "edge, 40 mm", "edge, 60 mm")
TIP, SCATTER, COAT, SPACING = 0.012, 0.1, 0.15, 3e-3
FIRST_SEED = 4100
DEAD = 7  # electrode
FITS, NETWORK, BOTH = "fits", "network", "both"


class Recorded(NamedTuple):
    """Readings of the untouched skin (readings,) V, their change by each touch (touches, readings) V, without noise."""

    untouched: np.ndarray
    change: np.ndarray

    @property
    def noise(self) -> float:
        """Of a reading, 60 dB below their rms, V."""
        return 1e-3 * float(np.sqrt(np.mean(self.untouched**2)))


def recorded(seed: int, given: list[Touch], misplaced: float = 0.0) -> Recorded:
    """A skin of a seed under touches, by the second simulator."""
    skin, own = read_skin(), np.random.default_rng([seed, 11])
    bolts = skin.bolts + misplaced * own.standard_normal(skin.bolts.shape)
    layer = contact.make_layer(skin, bolts, SCATTER, own)
    mesh = make_mesh(skin, bolts, SPACING)
    sigma = coating(mesh.points[mesh.triangles].mean(1), COAT, own) / skin.resistance
    sheet = make_sheet(mesh, sigma, skin.contact)
    volts = [readings(z, skin.pattern, skin.current) for z in transfer_frames(layer, sheet, _loads(layer, given))]
    untouched = readings(sheet.untouched, skin.pattern, skin.current)
    return Recorded(untouched, np.array(volts) - untouched)


def _loads(layer: contact.Layer, given: list[Touch]) -> np.ndarray:
    """Load on each patch, (touches, patches) N."""

    def of_touch(touch: Touch) -> np.ndarray:
        tips = zip(touch.places, touch.loads, strict=True)
        return sum(load * contact.shares(layer, place, "flat", TIP, load) for place, load in tips if load)

    return np.array([of_touch(touch) for touch in given])


class Answer(NamedTuple):
    """Probabilities (kinds,), places of the loads of each kind, and milliseconds."""

    probability: np.ndarray
    place: Callable[[LoadKind], np.ndarray]
    ms: float


def ways(run: Run) -> Iterator[Row]:
    """Each way to tell what touches the skin, on the same frames."""
    skins, singles, others = run.sizes((2, 8, 3), (1, 1, 1))
    proposal = je.contacts.load_proposal("testbed")
    model, every = je.discretise(je.Scene(je.load_skin("testbed")), FIDELITY), []
    for seed in range(FIRST_SEED, FIRST_SEED + skins):
        rng = np.random.default_rng(seed)
        given = [t for t in touches(rng, singles, others, np.zeros(2), np.full(2, 0.2)) if t.name in NAMES]
        found = recorded(seed, given)
        blank = found.untouched + found.noise / np.sqrt(BLANKS) * rng.normal(size=found.untouched.size)
        noise, sheet = np.full(blank.size, found.noise), je.fit_background(model, blank)
        fitter = je.contacts.prepare_loads(model, noise=noise, sigma=sheet)
        finder = je.prepare_contacts(model, noise=noise, sigma=sheet)
        for touch, change in zip(given, found.change, strict=True):
            frame = change + found.noise * rng.normal(size=change.size)
            for way, answer in _answers(frame, proposal, fitter, finder):
                every.append({"way": way} | judged(touch, answer))
        print(f"skin {seed}", flush=True)
    yield {"rows": list(_means(every))}


def _answers(frame: np.ndarray, proposal: Proposal, fitter: LoadFitter, finder: Any) -> Iterator[tuple[str, Answer]]:
    proposal(frame), fitter.refine(frame, proposal(frame))  # what is compiled is compiled
    spent, searched = seconds(lambda: jax.block_until_ready(fitter(frame, finder(frame))))
    yield FITS, _fitted(searched, spent)
    spent, proposed = seconds(lambda: proposal(frame))
    yield NETWORK, Answer(proposed.probability, lambda kind: proposed.of(kind)[:, :2], 1e3 * spent)
    spent, refined = seconds(lambda: jax.block_until_ready(fitter.refine(frame, proposal(frame))))
    yield BOTH, _fitted(refined, spent)


def _fitted(found: Loads, spent: float) -> Answer:
    def place(kind: LoadKind) -> np.ndarray:
        shape = found.of(kind) or found.one
        return np.asarray(shape.position)

    return Answer(np.asarray(found.probability), place, 1e3 * spent)


def judged(touch: Touch, answer: Answer) -> Row:
    """What is right of an answer; of loads of the true kind, how far they are from the true ones."""
    kind, place = LoadKind(int(answer.probability.argmax())), answer.place(touch.kind)
    several = kind in (LoadKind.TWO, LoadKind.MORE)
    near = matched(place, touch.truth) if touch.kind is LoadKind.TWO else True
    away = np.linalg.norm(place[:, None] - touch.truth, axis=2)
    return {
        "name": touch.name,
        "told": kind is touch.kind and near,
        "several": several,
        "error_mm": 1e3 * float(away.min(0).mean()),
        "surprise": -float(np.log(max(answer.probability[touch.kind], 1e-6))),
        "ms": answer.ms,
    }


def _means(every: list[Row]) -> Iterator[Row]:
    for way, of_way in grouped(every, "way").items():
        for name, mine in grouped(of_way, "name").items():
            means = {key: float(np.mean([row[key] for row in mine])) for key in ("told", "several", "surprise")}
            middle = {key: float(np.median([row[key] for row in mine])) for key in ("error_mm", "ms")}
            rounded = {key: round(value, 4) for key, value in (means | middle).items()}
            yield {"touch": name, "way": way, "frames": len(mine)} | rounded


def stated(run: Run) -> Iterator[Row]:
    """Reliability of the network's probabilities on touches of all kinds, and what it announces."""
    skins, singles, others = run.sizes((2, 30, 4), (1, 2, 1))
    proposal, proposed, true, unlike = je.contacts.load_proposal("testbed"), [], [], []
    for seed in range(FIRST_SEED + 50, FIRST_SEED + 50 + skins):
        rng = np.random.default_rng(seed)
        given = list(touches(rng, singles, others, np.zeros(2), np.full(2, 0.2)))
        found = recorded(seed, given)
        frames = found.change + found.noise * rng.normal(size=found.change.shape)
        proposed.append(proposal(frames).probability)
        true += [np.arange(len(LoadKind)) == touch.kind for touch in given]
        unlike += [
            {"frames_are": what, "announced": share} for what, share in _unlike(proposal, seed, given, found, rng)
        ]
        print(f"skin {seed}", flush=True)
    rows = [
        {"frames_are": what, "announced": round(float(np.mean([row["announced"] for row in mine])), 4)}
        for what, mine in grouped(unlike, "frames_are").items()
    ]
    yield {"reliability": reliability(np.concatenate(proposed), np.stack(true)), "unlike": rows}


def _unlike(
    proposal: Proposal, seed: int, given: list[Touch], found: Recorded, rng: np.random.Generator
) -> Iterator[tuple[str, float]]:
    """Share of frames that are announced as unlike the training, for several kinds of frames."""
    noise = found.noise * rng.normal(size=found.change.shape)
    frames, dead = found.change + noise, (read_skin().pattern == DEAD).any(1)
    aside = recorded(seed, given, 3e-3).change + noise
    for what, changed in (
        ("of the second simulator", frames),
        ("with noise 50 dB below the readings", found.change + 10**0.5 * noise),
        ("with noise 40 dB below the readings", found.change + 10 * noise),
        ("without the readings of an electrode", np.where(dead, np.nan, frames)),
        ("with an electrode that reads nothing, unnoticed", np.where(dead, 0, frames)),
        ("with readings in another order", np.roll(frames, 1, axis=1)),
        ("with bolts 3 mm aside", aside),
    ):
        yield what, float(np.mean(proposal(changed).distance > 1))


CASES = {
    "held_out": "whole",
    "without_pads": "without pads",
    "without_pads_and_an_electrode": "without pads and an electrode",
}


def shipped(run: Run) -> Iterator[Row]:
    """What the training of the shipped numbers found on skins that it held out."""
    about = je.contacts.load_proposal("testbed").about
    kinds = ((case, kind, row) for case in CASES for kind, row in about[case]["kinds"].items() if kind != "none")
    yield {"held_out": [{"case": CASES[case], "kind": kind} | row for case, kind, row in kinds]}


main = Question("proposal", __doc__, {"stated": stated, "shipped": shipped, "ways": ways})

if __name__ == "__main__":
    main()
