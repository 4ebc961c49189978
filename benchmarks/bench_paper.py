"""The shipped scene `paper_bench` against the paper, over seeds; and the same at fixed force for other load spreading.

Each seed has a sheet, a protrusion layer, noise and drift of its own.  Localisation by centroids of the image and by
the fit of contacts; coefficients of variation of the EIT sum, of the hybrid (the paper's recipe) and of that corrected
for the contact's place, predicted by fits that have not seen the place, as `jaxeit calibrate --location edge` prints
them; images and hybrid as with ``--even-sheet``, which is the paper's way.  To save time ten frames a second are
simulated, each a mean of eighteen scans.  Parameters of the scene marked "chosen" were chosen so that these numbers
resemble the paper's: they show consistency, not that the paper's skin works so.  Further rows spread the load otherwise
at the same force, one seed each.
"""

import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.runtime import set_up

from .harness import Question, Run
from .rows import Row

SCENE = 0.01  # m, the spreading of the shipped scene
WIDTHS = (0.006, 0.008, SCENE, 0.012, 0.016, 0.020)
EIT_RATE, SCANS, SEEDS = 10.0, 18, 6
PAPER = {"localisation_quarter_mean": "6.9", "cv_eit_ddof1": "0.31", "cv_hybrid_ddof1": "0.14"}
PAPERS, OURS = calib.Recipe(even_sheet=True), calib.Recipe(location=calib.PadEdge())
NUMBERS = (
    *(f"localisation_{what}" for what in ("quarter_mean", "half_mean", "peak_mean", "quarter_inward_bias")),
    *("localisation_fitted_mean", "cv_eit_ddof1", "cv_hybrid_ddof1", "cv_calibrated_ddof1"),
)
NUMBERS_OF_OURS = ("localisation_fitted_mean", "cv_calibrated_ddof1")


def measure(run: Run) -> Iterator[Row]:
    """A row for each load spreading: mean and standard deviation over the seeds."""
    seeds = 1 if run.smoke else SEEDS
    yield {"seeds": seeds, "paper": PAPER}
    for width in run.sizes(WIDTHS, (SCENE,)):
        found = [figures(seed, width, run.smoke) for seed in range(seeds if width == SCENE else 1)]
        row: Row = {"spreading_mm": 1e3 * width, "seeds": len(found)}
        for name, values in zip(NUMBERS, np.transpose(found), strict=True):
            row[name] = [float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else 0.0]
        yield {"rows": [row]}


def seeded(seed: int, width: float, smoke: bool) -> Bench:
    """The scene with all its chance drawn anew."""
    bench = load_bench("paper_bench")
    effects = tuple(_reseeded(effect, seed, width) for effect in bench.scene.effects)
    changes: dict[str, Any] = {"sites": bench.sites[::13]} if smoke else {}
    scene = je.Scene(bench.scene.skin, effects)
    return dataclasses.replace(bench, scene=scene, eit_rate=EIT_RATE, pad_rate=20.0, seed=seed, **changes)


def _reseeded(effect: Any, seed: int, width: float) -> Any:
    match effect:
        case je.effects.CoatingNonUniformity() | je.effects.ContactGain():
            return eqx.tree_at(lambda e: e.seed, effect, np.asarray(1000 + seed))
        case je.effects.LoadSpreading():
            return je.effects.LoadSpreading(width=width)
        case je.effects.Noise(stream=je.effects.StreamKind.EIT):
            return eqx.tree_at(lambda e: e.std, effect, effect.std / SCANS**0.5)
    return effect


def figures(seed: int, width: float, smoke: bool) -> list[float]:
    """NUMBERS as `jaxeit calibrate` finds them."""
    fidelity = je.Fidelity.draft() if smoke else None
    with tempfile.TemporaryDirectory() as folder:
        path = simulate(seeded(seed, width, smoke), Path(folder) / "session.h5", fidelity=fidelity)
        with calib.open_session(path) as session:
            paper, ours = (calib.calibrate([session], recipe=recipe).evaluation.summary() for recipe in (PAPERS, OURS))
    found = paper | {name: ours[name] for name in NUMBERS_OF_OURS}
    print(f"seed {seed}, spreading {1e3 * width:g} mm: " + ", ".join(f"{k} {found[k]:.3g}" for k in NUMBERS))
    return [float(found[name]) for name in NUMBERS]


main = Question("paper", __doc__, {"rows": measure}, prepare=set_up)

if __name__ == "__main__":
    main()
