"""The shipped scene `paper_bench` against the paper, over seeds; and the same at fixed force for other load spreading.

python -m benchmarks.bench_paper [--seeds 6] [--smoke]

Each seed has a sheet, a protrusion layer, noise and drift of its own.  Localisation by centroids of the image and by
the fit of contacts; coefficients of variation of the EIT sum, of the hybrid (the paper's recipe) and of that corrected
for the contact's place, predicted by fits that have not seen the place, as `jaxeit calibrate --location edge` prints
them.  To save time ten frames a second are simulated, each a mean of eighteen scans.  Parameters of the scene marked
"chosen" were chosen so that these numbers resemble the paper's: they show consistency, not that the paper's skin works
so.  Further rows spread the load otherwise at the same force, one seed each.
"""

import argparse
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.runtime import set_up

from . import _common as c

SCENE = 0.01  # m, the spreading of the shipped scene
WIDTHS = (0.006, 0.008, SCENE, 0.012, 0.016, 0.020)
EIT_RATE, SCANS = 10.0, 18
COLUMNS = {
    "localisation_quarter_mean": ("localisation, quarter, mm", 1e3),
    "localisation_half_mean": ("half, mm", 1e3),
    "localisation_peak_mean": ("peak, mm", 1e3),
    "localisation_quarter_inward_bias": ("inward, mm", 1e3),
    "cv_eit_ddof1": ("CV, EIT only", 1),
    "cv_hybrid_ddof1": ("CV, hybrid", 1),
    "localisation_fitted_mean": ("contacts fitted, mm", 1e3),
    "cv_calibrated_ddof1": ("CV, hybrid corrected for the place", 1),
}
PAPER = {"localisation_quarter_mean": "6.9", "cv_eit_ddof1": "0.31", "cv_hybrid_ddof1": "0.14"}


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--smoke", action="store_true", help="few presses, coarse; writes nothing")
    args = parser.parse_args(argv)
    set_up()
    before, seeds = c.circumstances(), range(1 if args.smoke else args.seeds)
    widths = (SCENE,) if args.smoke else WIDTHS
    several = {width: seeds if width == SCENE else seeds[:1] for width in widths}
    results = {width: [figures(seed, width, args.smoke) for seed in mine] for width, mine in several.items()}
    data = {
        "seeds": len(seeds),
        "paper": PAPER,
        "rows": [{"spreading_mm": 1e3 * width, "seeds": len(rows)} | summary(rows) for width, rows in results.items()],
        "circumstances": before,
    }
    print(table(data["rows"]))
    if not args.smoke:
        print(c.write("paper", c.closed(data)))
    return data


def seeded(seed: int, width: float, smoke: bool) -> Bench:
    """The scene with all its chance drawn anew."""
    bench = load_bench("paper_bench")
    effects = tuple(_reseeded(effect, seed, width) for effect in bench.scene.effects)
    changes: dict[str, Any] = {"sites": bench.sites[::13]} if smoke else {}
    scene = je.Scene(bench.scene.skin, effects)
    return dataclasses.replace(bench, scene=scene, eit_rate=EIT_RATE, pad_rate=20.0, seed=seed, **changes)


def _reseeded(effect: Any, seed: int, width: float) -> Any:
    match effect:
        case je.CoatingNonUniformity() | je.ContactGain():
            return eqx.tree_at(lambda e: e.seed, effect, np.asarray(1000 + seed))
        case je.LoadSpreading():
            return je.LoadSpreading(width=width)
        case je.Noise(stream=je.Stream.EIT):
            return eqx.tree_at(lambda e: e.std, effect, effect.std / SCANS**0.5)
    return effect


def figures(seed: int, width: float, smoke: bool) -> dict[str, float]:
    """What `jaxeit calibrate` finds."""
    fidelity = je.Fidelity.draft() if smoke else None
    with tempfile.TemporaryDirectory() as folder:
        path = simulate(seeded(seed, width, smoke), Path(folder) / "session.h5", fidelity=fidelity)
        with calib.open_session(path) as session:
            found = calib.calibrate([session], location=calib.PadEdge()).evaluation.summary()
    print(f"seed {seed}, spreading {1e3 * width:g} mm: " + ", ".join(f"{k} {found[k]:.3g}" for k in COLUMNS))
    return {name: float(found[name]) for name in COLUMNS}


def summary(rows: list[dict[str, float]]) -> dict[str, list[float]]:
    """Mean and standard deviation over the seeds."""
    out = {}
    for name in COLUMNS:
        values = np.array([row[name] for row in rows])
        out[name] = [float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else 0.0]
    return out


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line per spreading, mean ± standard deviation over the seeds."""
    lines = ["| load spreading (seeds) | " + " | ".join(label for label, _ in COLUMNS.values()) + " |"]
    lines.append("|---" * (1 + len(COLUMNS)) + "|")
    for row in rows:
        cells = [_cell(*row[name], scale, row["seeds"]) for name, (_, scale) in COLUMNS.items()]
        lines.append(f"| {row['spreading_mm']:g} mm ({row['seeds']}) | " + " | ".join(cells) + " |")
    lines.append("| the paper, on hardware | " + " | ".join(PAPER.get(name, "") for name in COLUMNS) + " |")
    return "\n".join(lines) + "\n"


def _cell(mean: float, std: float, scale: float, seeds: int) -> str:
    digits = 1 if scale > 1 else 3
    return f"{scale * mean:.{digits}f}" + (f" ± {scale * std:.{digits}f}" if seeds > 1 else "")


if __name__ == "__main__":
    main()
