"""What a learned proposal is worth: fits alone, the network alone, and both, on frames that another simulator made.

Frames come from the second simulator (`tests/oracles/bench`), which shares no code with the first, on skins of fresh
seeds: protrusions one by one, Boussinesq's stress, tips of 12 mm, an uneven coat, noise 60 dB below the readings, 20 N.
The skins are the testbed and the chest. The network has the shipped numbers for the skin, and sees neither the
untouched frame nor the pads. Fits know the sheet from one untouched frame. "Taught" fits also know what 16 presses of
known place and force on the same skin tell (`jaxeit.contacts.learn_loads`): flat tips of 20 mm, 4 to 25 N.

ways: single tips, equal pairs at 20 and 30 mm, edges of 40 and 60 mm, three tips, each with its error of place. "told":
the most probable kind is the true one, and for two both places are nearer than half their distance. "several": more
than one load is the most probable. "surprise": mean of minus the log probability of the true kind, at most that of
1e-6. ways_reliability: how often the kinds that each way states are the true ones.

reliability: how often the kinds that the network states are the true ones, on touches of all kinds. Pairs nearer than
`LoadSettings.nearest` and edges shorter than `LoadSettings.shortest` are one load, as the network and the fits have it.

alone: place and force of single tips of 6 to 30 mm, 4 to 25 N, by readings alone, before and after those presses.

times: milliseconds a frame of each way.

held_out: figures of the shipped numbers on skins that their training held out.

unlike: frames from outside of the training, and how many of them are announced.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

import jaxeit as je
from jaxeit.contacts import LoadFitter, LoadKind, Loads, Proposal

from .bench_loads import Touch, held, reliability, touches
from .clock import seconds
from .harness import Question, Run
from .problems import Pressed, fit_model, matched
from .rows import Row, grouped, rounded
from .second_simulator import Press, Wear, alike, described, presses as single_tips, recorded as pressed

NAMES = ("one", "two, 1:1, 20 mm", "two, 1:1, 30 mm", "edge, 40 mm", "edge, 60 mm", "three")
SHIPPED = ("testbed", "chest")
TIP = 0.012  # m
FIRST_SEED = 4300
DEAD = 7  # electrode
FITS, TAUGHT, NETWORK, BOTH, BOTH_TAUGHT = "fits", "fits, taught", "network", "both", "both, taught"
PRESSES, PRESS_TIP = 16, 0.02  # that teach; m


def recorded(name: str, seed: int, given: list[Touch], misplaced: float = 0.0) -> Pressed:
    """A skin of a name and a seed under touches, by the second simulator."""
    return pressed(seed, tips(given), Wear(misplaced=misplaced), name)


def tips(given: list[Touch]) -> list[Press]:
    """The tips of touches."""
    return [Press(touch.places[touch.loads > 0], touch.loads[touch.loads > 0], TIP) for touch in given]


def touched(name: str, rng: np.random.Generator, singles: int, others: int) -> list[Touch]:
    """Touches of all kinds on a skin of a name."""
    return list(touches(rng, singles, others, np.zeros(2), described(name).size))


def counted(touch: Touch) -> LoadKind:
    """The kind of a touch; loads too near one another and edges too short are one load, by `LoadSettings`."""
    usual, there = je.contacts.LoadSettings(), touch.places[touch.loads > 0]
    length = float(np.linalg.norm(there[-1] - there[0]))
    least = {LoadKind.TWO: usual.nearest, LoadKind.EDGE: usual.shortest}.get(touch.kind, 0.0)
    return touch.kind if length >= least else LoadKind.ONE


class Answer(NamedTuple):
    """Probabilities (kinds,) of a touch, and places of the loads of each kind."""

    probability: np.ndarray
    place: Callable[[LoadKind], np.ndarray]


class Ready(NamedTuple):
    """A skin whose sheet is known from an untouched frame, and what tells its touches."""

    proposal: Proposal
    fitter: LoadFitter
    taught: LoadFitter
    finder: je.contacts.ContactFinder

    def searched(self, frame: np.ndarray, taught: bool = False) -> Loads:
        """Loads by a search."""
        return self.fits(taught)(frame, self.finder(frame))

    def refined(self, frame: np.ndarray, taught: bool = False) -> Loads:
        """Loads by the network and fits from where it proposes."""
        return self.fits(taught).refine(frame, self.proposal(frame), self.finder(frame))

    def fits(self, taught: bool) -> LoadFitter:
        """The fits of loads, as presses have taught them or as usual."""
        return self.taught if taught else self.fitter


def ways(run: Run) -> Iterator[Row]:
    """Each way to tell what touches the skin, on the same frames."""
    skins, singles, others = run.sizes((6, 8, 3), (1, 1, 1))
    for name in SHIPPED:
        every = []
        for seed in range(FIRST_SEED, FIRST_SEED + skins):
            for touch, frame, ready in noisy_frames(name, seed, singles, others):
                every += [{"way": way} | judged(touch, answer) for way, answer in _answers(frame, ready)]
            print(f"{name} {seed}", flush=True)
        of_skin = {"rows": _means(every), "ways_means": _whole(every)}
        yield {part: [{"skin": name} | row for row in rows] for part, rows in of_skin.items()} | {
            "ways_reliability": _stated(name, every)
        }


def noisy_frames(
    name: str, seed: int, singles: int, others: int, presses: int = PRESSES
) -> Iterator[tuple[Touch, np.ndarray, Ready]]:
    """Touches of `NAMES` on the skin of a seed, with a noisy frame each, and what tells them after some presses."""
    rng = np.random.default_rng(seed)
    given = [touch for touch in touched(name, rng, singles, others) if touch.name in NAMES]
    frames, ready = _seen(name, seed, tips(given), presses, rng)
    for touch, frame in zip(given, frames, strict=True):
        yield touch, frame, ready


def _seen(
    name: str, seed: int, given: list[Press], presses: int, rng: np.random.Generator
) -> tuple[Iterator[np.ndarray], Ready]:
    """Noisy frames of a skin under presses, and what tells them after some further presses."""
    own = np.random.default_rng([seed, 1])
    lessons, model = alike(own, presses, PRESS_TIP, name), fit_model(name)
    both = pressed(seed, [*given, *lessons], Wear(), name)
    known = {"noise": both.std, "sigma": je.fit_background(model, both.blank(rng))}
    noisy = both.change[len(given) :] + both.noise * own.normal(size=(presses, both.change.shape[1]))
    fitter = taught = je.contacts.prepare_loads(model, **known)
    if presses:
        truth = (np.concatenate([getattr(one, name) for one in lessons]) for name in ("places", "forces"))
        learned = je.contacts.learn_loads(model, noisy, *truth, **known)
        print(learned.changed(), flush=True)
        taught = je.contacts.prepare_loads(model, learned, **known)
    ready = Ready(je.contacts.load_proposal(name), fitter, taught, je.prepare_contacts(model, **known))
    changes = both.change[: len(given)]
    return (change + both.noise * rng.normal(size=change.size) for change in changes), ready


def _answers(frame: np.ndarray, ready: Ready) -> Iterator[tuple[str, Answer]]:
    proposed = ready.proposal(frame)
    yield FITS, _fitted(ready.searched(frame))
    yield NETWORK, Answer(proposed.probability, lambda kind: proposed.of(kind)[:, :2])
    yield BOTH, _fitted(ready.refined(frame))
    yield TAUGHT, _fitted(ready.searched(frame, taught=True))
    yield BOTH_TAUGHT, _fitted(ready.refined(frame, taught=True))


def _fitted(found: Loads) -> Answer:
    def place(kind: LoadKind) -> np.ndarray:
        shape = found.of(kind) or found.one
        return np.asarray(shape.position)

    return Answer(np.asarray(found.probability), place)


def alone(run: Run) -> Iterator[Row]:
    """Place and force of single tips by their readings alone, before and after presses have taught the fits."""
    skins, count = run.sizes((6, 16), (1, 2))
    for name in SHIPPED:
        every = []
        for seed in range(FIRST_SEED + 80, FIRST_SEED + 80 + skins):
            rng = np.random.default_rng(seed)
            given = single_tips(rng, count, name=name)
            frames, ready = _seen(name, seed, given, PRESSES, rng)
            for press, frame in zip(given, frames, strict=True):
                every += [{"way": way} | _missed(press, ready.searched(frame, way == TAUGHT)) for way in (FITS, TAUGHT)]
            print(f"{name} {seed}", flush=True)
        for way, mine in grouped(every, "way").items():
            means = {
                key: float(np.mean([row[key] for row in mine])) for key in ("place_covered", "force_covered", "several")
            }
            for key in ("place_mm", "force"):
                off = [row[key] for row in mine]
                means |= {key: float(np.median(off)), f"{key}_90": float(np.quantile(off, 0.9))}
            yield {"alone": [{"skin": name, "way": way, "frames": len(mine)} | rounded(means)]}


def _missed(press: Press, found: Loads) -> Row:
    """By how much the best single load misses a press, and whether its 90 % ellipse and interval hold."""
    (place,), (force,), _ = press
    hit = held(found.one, place, force)
    return {
        "place_mm": hit["error_mm"],
        "force": abs(float(found.one.force[0]) / force - 1),
        "place_covered": hit["place"],
        "force_covered": hit["force"],
        "several": found.kind in (LoadKind.TWO, LoadKind.MORE),
    }


def times(run: Run) -> Iterator[Row]:
    """Milliseconds a frame of each way, on the testbed."""
    (singles, others), rows = run.sizes((6, 2), (1, 1)), []
    for touch, frame, ready in noisy_frames("testbed", FIRST_SEED - 1, singles, others):
        ready.refined(frame)  # what is compiled is compiled
        ways = {FITS: ready.searched, NETWORK: ready.proposal, BOTH: ready.refined}
        ways |= {TAUGHT: partial(ready.searched, taught=True), BOTH_TAUGHT: partial(ready.refined, taught=True)}
        for way, tell in ways.items():
            spent, _ = seconds(lambda tell=tell, frame=frame: jax.block_until_ready(tell(frame)))
            rows.append({"touch": touch.name, "way": way, "ms": 1e3 * spent})
    middle = {way: np.median([row["ms"] for row in mine]) for way, mine in grouped(rows, "way").items()}
    yield {"times": [{"way": way, "ms": round(float(ms), 4)} for way, ms in middle.items()]}


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
        "probability": answer.probability,
        "true": np.arange(len(LoadKind)) == counted(touch),
    }


def _stated(name: str, every: list[Row]) -> list[Row]:
    """Reliability of what each way states."""
    return [
        {"skin": name, "way": way} | row
        for way, mine in grouped(every, "way").items()
        for row in reliability(*(np.stack([one[key] for one in mine]) for key in ("probability", "true")))
    ]


def _means(every: list[Row]) -> Iterator[Row]:
    for way, of_way in grouped(every, "way").items():
        for name, mine in grouped(of_way, "name").items():
            yield {"touch": name, "way": way} | _summary(mine, "told", "several", "surprise")


def _whole(every: list[Row]) -> Iterator[Row]:
    """Means over all touches, and how many single tips were called several."""
    for way, mine in grouped(every, "way").items():
        false = float(np.mean([row["several"] for row in mine if row["name"] == NAMES[0]]))
        yield {"way": way} | _summary(mine, "told", "surprise") | rounded({"false_several": false})


def _summary(mine: list[Row], *names: str) -> Row:
    """The number of frames, means under some names, and the median error of place."""
    means = {name: float(np.mean([row[name] for row in mine])) for name in names}
    means["error_mm"] = float(np.median([row["error_mm"] for row in mine]))
    return {"frames": len(mine)} | rounded(means)


def stated(run: Run) -> Iterator[Row]:
    """Reliability of the network's probabilities on touches of all kinds, and what it announces."""
    skins, singles, others = run.sizes((6, 20, 4), (1, 2, 1))
    for name in SHIPPED:
        proposal, proposed, true, unlike = je.contacts.load_proposal(name), [], [], []
        for seed in range(FIRST_SEED + 50, FIRST_SEED + 50 + skins):
            rng = np.random.default_rng(seed)
            given = touched(name, rng, singles, others)
            found = recorded(name, seed, given)
            frames = found.change + found.noise * rng.normal(size=found.change.shape)
            proposed.append(proposal(frames).probability)
            true += [np.arange(len(LoadKind)) == counted(touch) for touch in given]
            pairs = _unlike(name, proposal, seed, given, found, rng)
            unlike += [{"frames_are": what, "announced": share} for what, share in pairs]
            print(f"{name} {seed}", flush=True)
        told = reliability(np.concatenate(proposed), np.stack(true))
        yield {"reliability": [{"skin": name} | row for row in told], "unlike": _announced(name, unlike)}


def _announced(name: str, unlike: list[Row]) -> list[Row]:
    return [
        {"skin": name, "frames_are": what, "announced": round(float(np.mean([row["announced"] for row in mine])), 4)}
        for what, mine in grouped(unlike, "frames_are").items()
    ]


def _unlike(
    name: str, proposal: Proposal, seed: int, given: list[Touch], found: Pressed, rng: np.random.Generator
) -> Iterator[tuple[str, float]]:
    """Share of frames that are announced as unlike the training, for several kinds of frames."""
    noise = found.noise * rng.normal(size=found.change.shape)
    frames, dead = found.change + noise, (described(name).pattern == DEAD).any(1)
    aside = recorded(name, seed, given, 3e-3).change + noise
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
    for name in SHIPPED:
        about = je.contacts.load_proposal(name).about
        kinds = ((case, kind, row) for case in CASES for kind, row in about[case]["kinds"].items() if kind != "none")
        yield {"held_out": [{"skin": name, "case": CASES[case], "kind": kind} | row for case, kind, row in kinds]}


main = Question(
    "proposal", __doc__, {"stated": stated, "shipped": shipped, "ways": ways, "alone": alone, "times": times}
)

if __name__ == "__main__":
    main()
