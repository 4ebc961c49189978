"""What misplaced electrodes cost a calibration, and what of that `calibrate --fit-electrodes` wins back.

The scene of the bundled session is simulated on skins whose bolts are drilled aside by 1.1 mm (standard deviation, in x
and in y), for seeds that nothing was chosen by. Each session is calibrated three times: by the skin's file, which knows
nothing of that; by the same file with the electrodes fitted; and by the skin as it is, the bound. Rows are means over
the seeds.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate

from .harness import ROOT, Question, Run
from .rows import Row, averaged, grouped

SCENE = ROOT / "data" / "sessions" / "testbed_grid.toml"
MISPLACED = 1.1e-3  # m
FIRST_SEED = 21
FILED, FITTED, TRUE = "as the file says", "fitted", "as they sit"


def measure(run: Run) -> Iterator[Row]:
    bench, skin, rows = load_bench(str(SCENE)), je.load_skin("testbed"), []
    for seed in range(FIRST_SEED, FIRST_SEED + run.sizes(4, 1)):
        shift = np.random.default_rng(seed).normal(scale=MISPLACED, size=skin.electrode_positions.shape)
        there = je.skin.with_positions(skin, skin.electrode_positions + shift)
        rows += list(calibrated(bench, skin, there, run.sizes((FILED, FITTED, TRUE), (FILED, TRUE))))
        print(f"seed {seed}", flush=True)
    means = [averaged(of_skin) | {"skins": len(of_skin)} for of_skin in grouped(rows, "electrodes").values()]
    yield {"rows": means}


def calibrated(bench: Bench, skin: je.Skin, there: je.Skin, ways: tuple[str, ...]) -> Iterator[Row]:
    """A row for each way to say where the electrodes sit."""
    inner = np.abs(skin.electrode_positions - 0.1).max(1) < 0.05
    with tempfile.TemporaryDirectory() as folder:
        path = simulate(replace(bench, scene=replace(bench.scene, skin=there)), Path(folder) / "session.h5")
        for way in ways:
            recipe = calib.Recipe(location=calib.PadEdge(), fit_electrodes=way == FITTED)
            with calib.open_session(path) as session:
                found = calib.calibrate([session], there if way == TRUE else skin, recipe=recipe)
            off = found.skin.electrode_positions - there.electrode_positions
            place = np.linalg.norm(found.evaluation.estimated["fitted"] - found.evaluation.position, axis=1)
            yield {
                "electrodes": way,
                "off_mm": 1e3 * float(np.sqrt(np.mean(off**2))),
                "inner_mm": 1e3 * float(np.sqrt(np.mean(off[inner] ** 2))),
                "place_mm": 1e3 * float(place.mean()),
                "p95_mm": 1e3 * float(np.percentile(place, 95)),
                "force_n": float(found.evaluation.summary()["force_rmse"]),
            }


main = Question("electrodes", __doc__, {"calibrations": measure})

if __name__ == "__main__":
    main()
