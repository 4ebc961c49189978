"""What corrections by location leave of forces, on skins that nothing was chosen by.

Each skin has a coat, a contact layer, a spread of the load and walls of its own: the scene of the bundled session with
other seeds and widths. It is pressed on a grid whose outer lines lie 10 mm from the rim, or at random places, with 5,
10 and 20 N; places are those that contacts fitted to the frames tell. Each calibration predicts 120 presses of 4 to
20 N at other random places of the same skin.

Error: root mean square over all presses of all skins. Covered: presses within their 90 % interval, and the same on the
skin with the fewest; in thirds by force. Interval: its mean half width.
"""

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
from calib.bench import Bench, load_bench, simulate
from calib.calibration.evaluation import FORCE_THIRDS, Evaluation
from calib.fitting.cross_validation.scores import rmse
from jaxeit import effects as fx

from .harness import ROOT, Question, Run
from .rows import Row, grouped

SCENE = ROOT / "data" / "sessions" / "testbed_grid.toml"
FIRST_SEED, SKINS, TESTS = 40, 6, 120
LEVELS = (5.0, 10.0, 20.0)  # N
LOW, HIGH = 0.01, 0.19  # m, of places along each side
GRIDS, SCATTERED = (8, 12), (36, 64, 144)
CORRECTIONS = {"none": None, "edge": calib.PadEdge(), "edge-spline": calib.PadEdgeSpline()}


def skin_of(bench: Bench, rng: np.random.Generator, seed: int) -> Bench:
    """The bench with a skin of its own."""
    drawn: dict[type, Row] = {
        fx.CoatingNonUniformity: {"seed": seed},
        fx.ContactGain: {"seed": seed + 1000},
        fx.LoadSpreading: {"width": rng.uniform(0.009, 0.013)},
        fx.PadEdgeDip: {"depth": rng.uniform(0.3, 0.5), "width": rng.uniform(0.007, 0.013)},
    }
    effects = tuple(replace(one, **drawn.get(type(one), {})) for one in bench.scene.effects)
    return replace(bench, scene=replace(bench.scene, effects=effects))


def layouts(rng: np.random.Generator, grids: Iterable[int], counts: Iterable[int]) -> Iterator[tuple[str, np.ndarray]]:
    """Names and places (n, 2), m, of the presses that are calibrated from."""
    for side in grids:
        line = np.linspace(LOW, HIGH, side)
        yield f"grid of {side} x {side}", np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    for count in counts:
        yield f"{count} scattered", rng.uniform(LOW, HIGH, (count, 2))


def measure(run: Run) -> Iterator[Row]:
    """Rows by layout and correction, over all skins."""
    skins, tests, grids, counts = run.sizes((SKINS, TESTS, GRIDS, SCATTERED), (1, 4, (6,), ()))
    recipe = calib.Recipe(locator=calib.calibration.ImageCentroid(), folds=2) if run.smoke else calib.Recipe()
    bench, found = load_bench(str(SCENE)), []
    for seed in range(FIRST_SEED, FIRST_SEED + skins):
        rng = np.random.default_rng(seed)
        skin = skin_of(bench, rng, seed)
        others = replace(skin, sites=rng.uniform(LOW, HIGH, (tests, 2)), forces=rng.uniform(4, 20, tests), seed=seed)
        with tempfile.TemporaryDirectory() as folder:
            test = simulate(others, Path(folder) / "test.h5")
            for number, (layout, sites) in enumerate(layouts(rng, grids, counts)):
                forces, again = rng.choice(LEVELS, len(sites)), 1000 * (1 + number) + seed
                path = simulate(replace(skin, sites=sites, forces=forces, seed=again), Path(folder) / f"{number}.h5")
                for name, field in CORRECTIONS.items():
                    seen = predicted(path, test, replace(recipe, location=field))
                    found.append({"layout": layout, "location": name, "seen": seen})
                print(seed, layout, flush=True)
    yield {"rows": [judged(key, same) for key, same in grouped(found, "layout", "location").items()]}


def predicted(path: Path, test: Path, recipe: calib.Recipe) -> Evaluation:
    """The presses of one session by a calibration from another."""
    with calib.open_session(path) as session:
        calibration = calib.calibrate([session], recipe=recipe)
    with calib.open_session(test) as session:
        return calib.evaluate(calibration, session)


def judged(key: tuple[str, str], same: list[Row]) -> Row:
    """Errors and coverage of all presses that were predicted from a layout with a correction."""
    seen = [one["seen"] for one in same]
    each = [one.summary() for one in seen]
    told, true = (np.concatenate([getattr(one, name) for one in seen]) for name in ("total_force", "force"))
    width = np.concatenate([one.half_width for one in seen])
    thirds = {name: [one[f"coverage_{name}"] for one in each] for name in FORCE_THIRDS}
    return {
        "layout": key[0],
        "location": key[1],
        "skins": len(seen),
        "presses": len(true),
        "rmse_n": rmse(told, true),
        "worst_skin_n": max(one["force_rmse"] for one in each),
        "covered": float(np.mean(np.abs(told - true) <= width)),
        "covered_least": min(one["coverage"] for one in each),
        **{f"covered_{name}": float(np.mean(values)) for name, values in thirds.items()},
        "half_width_n": float(width.mean()),
    }


main = Question("location", __doc__, {"rows": measure})

if __name__ == "__main__":
    main()
