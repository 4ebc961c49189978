"""Physics, a regressor from end to end, and both: force maps of skins that another simulator made.

The regressor (`regressor`) is trained on the scenes of `jaxeit train`. Its last layer is adapted to each skin by 30 and
120 presses of ordinary use, of which the pads tell the forces; or by presses at known places. The tracker learns the
contact layer from the same presses. Frames come from the second simulator (`tests/oracles/bench`), which shares no code
with the first, on skins of fresh seeds: protrusions one by one, Boussinesq's stress, tips of 6 to 30 mm, 4 to 25 N, an
uneven coat, noise 60 dB below the readings. An untouched frame tells the sheet to all that is called physics, and to
the fits from a proposal. Pads tell their forces to 3 % and 0.1 N.

one, two: single tips, and equal pairs at 30 mm. Error of place: of maps, that of the vertex of each peak. "wrong":
share of the force on wrong pixels. "told": as many contacts as there are, of two both nearer than half their distance.
Force of the whole skin, root mean square of the relative error with all pads, and median from
the image alone, without any pad.

unlike: single tips, after 30 presses, on skins or by tips that are not as those of the training. "said": share of the
frames that the proposal calls outside of its scenes, or whose forces on the pads surprise the regressor (chi-square,
1 in 1,000).

drift: 48 presses in an hour, in which the gain of the contact layer falls by 26 % with a scatter of 20 %; after two
thirds a bolt in the middle comes loose, ten times its contact resistance. The untouched frame is that of the time.
"""

import tempfile
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.stats import chi2

import jaxeit as je
from jaxeit.tracking import LearnedLayer

from .clock import seconds
from .force_ways import Answer, Bench, Way
from .harness import Question, Run
from .problems import fit_model, matched
from .regressor import STEPS, Adapted, prepared
from .rows import Row, grouped
from .second_simulator import Press, Wear, true_map

FIRST_SEED = 5200
PRESSES = 120  # of ordinary use
AGED, WINDOWS = 48, 6  # presses and parts of the hour of a skin that ages
TAUGHT = {"never taught": 0.0, "taught for 20 minutes": 1 / 3, "always taught": 1.0}  # parts of the presses
FORGETTING_FACTOR = 0.005  # of what was learned, at each press
UNLIKE = {
    "bolts 3 mm aside": Wear(misplaced=3e-3),
    "tips of 50 mm": Wear(tip=0.05),
    "coat three times as uneven": Wear(coat=0.45),
}


def judged(truth: np.ndarray, press: Press, answer: Answer, alone: Answer) -> Row:
    """What is right of an answer with all pads, and of one from the image alone."""
    places = answer.places if len(press.forces) > 1 else answer.places[:1]
    away = np.linalg.norm(places[:, None] - press.places, axis=2)
    total = truth.sum()
    shares = answer.map / max(answer.map.sum(), 1e-9)
    return {
        "contacts": "one" if len(press.forces) == 1 else "two",
        "told": matched(answer.places, press.places) if len(press.forces) > 1 else len(answer.places) == 1,
        "place_mm": 1e3 * float(away.min(0).mean()) if len(places) else np.nan,
        "wrong": float(np.abs(shares - truth / total).sum() / 2),
        "force": float(answer.map.sum() / total - 1),
        "alone": float(alone.map.sum() / total - 1),
        "alone_n": float(abs(alone.map.sum() - total)),
    }


def measured(bench: Bench) -> Iterator[Row]:
    """Each way on all touches of a skin."""
    for way, tell in bench.ways().items():
        yield from ({"way": way} | row for row in judged_all(bench, tell))


def judged_all(bench: Bench, tell: Way) -> Iterator[Row]:
    """A way on all touches of a skin."""
    for press, frame, truth, pads in zip(bench.given, bench.frames, bench.truth, bench.pads, strict=True):
        spent, answer = seconds(tell, frame, pads)
        alone = tell(frame, np.full(len(pads), np.nan))
        yield {"ms": 1e3 * spent} | judged(truth, press, answer, alone)


def summary(rows: list[Row]) -> Row:
    """Medians, means and quantiles of rows of one way."""
    column = {key: np.array([row[key] for row in rows], float) for key in rows[0] if key not in ("way", "contacts")}
    image_alone = np.isfinite(column["alone"]).all()
    found = {
        "told": column["told"].mean(),
        "place_mm": np.nanmedian(column["place_mm"]),
        "place_mm_90": np.nanpercentile(column["place_mm"], 90),
        "wrong": np.median(column["wrong"]),
        "force": np.sqrt(np.mean(column["force"] ** 2)),
        "alone": np.median(np.abs(column["alone"])) if image_alone else np.nan,
        "alone_n": np.median(column["alone_n"]) if image_alone else np.nan,
        "ms": np.median(column["ms"]),
    }
    found |= {"said": column["said"].mean()} if "said" in column else {}
    return {"frames": len(rows)} | {key: round(float(x), 4) if np.isfinite(x) else None for key, x in found.items()}


def trained(run: Run) -> Adapted:
    """The regressor, trained once for all parts."""
    return _trained(run.args.frames, *run.sizes((240, STEPS), (8, 40)))


@cache
def _trained(kept: str | None, skins: int, steps: int) -> Adapted:
    """The regressor on frames that are drawn anew, or are those of a folder that is kept."""
    with tempfile.TemporaryDirectory() as folder:
        return prepared(je.load_skin("testbed"), Path(kept or folder), skins, steps)


def compared(run: Run) -> Iterator[Row]:
    """All ways on fresh skins."""
    skins, count = run.sizes((6, (PRESSES, 8, 5)), (1, (2, 1, 1)))
    adapted, model = trained(run), fit_model()
    every: list[Row] = []
    for seed in range(FIRST_SEED, FIRST_SEED + skins):
        every += measured(Bench(adapted, model, seed, Wear(), count))
        print(f"skin {seed}", flush=True)
    yield {contacts: tabled(mine) for contacts, mine in grouped(every, "contacts").items()}


def unlike(run: Run) -> Iterator[Row]:
    """Single tips on skins that are not as those of the training: what it costs, and what says so."""
    skins, count = run.sizes((1, (30, 10, 0)), (1, (30, 1, 0)))
    adapted, model = trained(run), fit_model()
    for what, wear in UNLIKE.items():
        rows: list[Row] = []
        for seed in range(FIRST_SEED + 100, FIRST_SEED + 100 + skins):
            rows += _unlike(Bench(adapted, model, seed, wear, count))
            print(f"{what}, skin {seed}", flush=True)
        yield {"unlike": [{"skin": what} | row for row in tabled(rows)]}


def _unlike(bench: Bench) -> Iterator[Row]:
    """Rows of some ways, with whether each announces that a frame is improbable; None: it never says so."""
    usual, seen = bench.beliefs(False), list(zip(bench.frames, bench.pads, strict=True))
    last, far = max(usual), chi2.ppf(0.999, len(bench.adapted.masks))
    ways: dict[str, tuple[Way, list]] = {"physics: loads fitted": (bench.by_search, [None] * len(seen))}
    for n in (0, last):
        surprised = [bench.adapted.surprise(usual[n], *one) > far for one in seen]
        ways[f"learned: regressor, {n} presses"] = partial(bench.by_network, usual[n]), surprised
    outside = bench.proposal(bench.frames, bench.pads).distance > 1
    ways["both: loads fitted from a proposal"] = bench.by_proposal, outside.tolist()
    for way, (tell, said) in ways.items():
        for row, announced in zip(judged_all(bench, tell), said, strict=True):
            yield {"way": way, "said": announced} | row


def drift(run: Run) -> Iterator[Row]:
    """Presses of an hour on skins that age: each is told from its readings alone before it teaches anything."""
    skins, count = run.sizes((2, (AGED, 1, 0)), (1, (6, 1, 0)))
    adapted, model = trained(run), fit_model()
    rows: list[Row] = []
    for seed in range(FIRST_SEED + 200, FIRST_SEED + 200 + skins):
        rows += _aged(Bench(adapted, model, seed, Wear(ages=True), count))
        print(f"skin that ages, {seed}", flush=True)
    yield {
        "drift": [
            {"way": way, "minutes": minutes, "presses": len(mine)}
            | {key: round(float(np.nanmedian([row[key] for row in mine])), 4) for key in ("alone", "place_mm")}
            for (way, minutes), mine in grouped(rows, "way", "minutes").items()
        ]
    }


def _aged(bench: Bench) -> Iterator[Row]:
    """Rows of each press, by what is never taught, taught for the first third of the hour, and always."""
    adapted, tracker, count = bench.adapted, bench.tracker, len(bench.used)
    codes, layers = (dict.fromkeys(TAUGHT, start) for start in (adapted.prior, LearnedLayer.unknown(tracker.field)))
    silent = np.full(len(adapted.masks), np.nan)
    for number, press in enumerate(bench.used):
        frame = bench.changes[number] + bench.noise * bench.rng.normal(size=bench.noise.size)
        truth = true_map(press, adapted.centres)
        (forces,) = bench.told(truth[None])
        window = WINDOWS * number // count
        minutes = f"{60 * window // WINDOWS} to {60 * (window + 1) // WINDOWS} min"
        for taught, until in TAUGHT.items():
            for way, found in (
                ("learned: regressor", bench.by_network(codes[taught], frame, silent)),
                ("physics: contacts followed", bench.by_tracks(layers[taught], frame, silent)),
            ):
                one = judged(truth, press, found, found)
                yield {"way": f"{way}, {taught}", "minutes": minutes} | {
                    "alone": abs(one["alone"]),
                    "place_mm": one["place_mm"],
                }
            if number < until * count:
                codes[taught] = adapted.told(codes[taught].aged(FORGETTING_FACTOR), frame, forces)
                layers[taught] = bench.learned_from(layers[taught].aged(FORGETTING_FACTOR), number)


def tabled(every: list[Row]) -> list[Row]:
    """A row for each way."""
    return [{"way": way} | summary(mine) for way, mine in grouped(every, "way").items()]


main = Question(
    "regressor",
    __doc__,
    {"compared": compared, "unlike": unlike, "drift": drift},
    {"--frames": {"help": "folder that keeps the frames"}},
)

if __name__ == "__main__":
    main()
