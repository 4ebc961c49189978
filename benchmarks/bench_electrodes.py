"""What misplaced electrodes cost a calibration, and what of that `calibrate --fit-electrodes` wins back.

The scene of the bundled session is simulated on skins whose bolts are drilled aside by 1.1 mm (standard deviation, in x
and in y), for seeds that nothing was chosen by. Each session is calibrated three times: by the skin's file, which knows
nothing of that; by the same file with the electrodes fitted; and by the skin as it is, the bound. Rows are means over
the seeds.

announced: skins of the second simulator (`tests/oracles/bench`), on which nothing was tuned, whose bolts sit aside by
so much in each direction (standard deviation). A session of 32 presses is checked and calibrated, by the skin's file
and with the electrodes fitted, and the calibration is applied to another session of the skin: which of these announce
it, and how far contacts and loads are told from where they are.

honest: sessions of skins whose electrodes sit where the file says: bundled ones, shipped scenes, and those of the
second simulator with other coats, tips and noise. None should be announced.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.calibration.application import FORMAT
from calib.calibration.localisation.load_windows import left_by_fits
from calib.check import check_session
from calib.check.placement import FIDELITY, WHERE, noted, placement_finding, with_placement
from calib.check.report import CheckReport
from calib.session import open_archive
from jaxeit.imaging import find_misplacement
from tests.oracles import bench as oracle

from . import worn_skins
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


# --- what announces it

ASIDE = (0.0, 0.5e-3, 1e-3, 2e-3, 3e-3)  # m
ANNOUNCED_SEED, FRAMES = 7400, 20
DRILLED = oracle.Bench(places=16, levels=(8.0, 16.0), spacing=3e-3)
LATER = replace(DRILLED, places=6, levels=(12.0,), seed=2)
NOISE = 1e-3 / np.sqrt(20)  # of a mean of twenty frames, 60 dB below the readings
WINDOW = 4.0  # s, of loads: one for each press


def announced(run: Run) -> Iterator[Row]:
    """Skins whose bolts sit aside: what says so, and what it costs without and with fitted electrodes."""
    skins, frames = run.sizes((2, FRAMES), (1, 1))
    for aside in run.sizes(ASIDE, ASIDE[:1]):
        rows = []
        for seed in range(ANNOUNCED_SEED, ANNOUNCED_SEED + skins):
            rows.append(
                {"aside_mm": 1e3 * aside} | drilled(oracle.Faults(misplaced=aside, coating=0.15), seed, run.smoke)
            )
            print(rows[-1], flush=True)
        yield {"announced": [averaged(rows) | {"skins": skins} | untouched(aside, frames)]}


def untouched(aside: float, count: int) -> Row:
    """How many untouched frames of further skins are announced, and the median size that is found in them."""
    skin, sizes, said = je.load_skin("testbed"), [], 0
    model = je.discretise(je.Scene(skin), FIDELITY)
    for seed in range(ANNOUNCED_SEED + 100, ANNOUNCED_SEED + 100 + count):
        rng = np.random.default_rng(seed)
        frame = worn_skins.recorded(seed, worn_skins.presses(rng, 1), worn_skins.Wear(misplaced=aside)).untouched
        rms = np.sqrt(np.mean(frame**2))
        frame = frame + NOISE * rms * rng.normal(size=frame.size)
        sizes.append(1e3 * float(find_misplacement(model, frame).size))
        said += placement_finding(skin, frame, np.ones(frame.size, bool)) is not None
    found = {"frames": count, "frames_said": said / count, "found_mm": round(float(np.median(sizes)), 3)}
    print(found, flush=True)
    return found


def drilled(faults: oracle.Faults, seed: int, smoke: bool) -> Row:
    """What is said of a skin, by each command as 0 or 1, and errors of places in mm."""
    first, later = (replace(one, faults=faults, skin_seed=seed) for one in (DRILLED, LATER))
    with recorded(first) as session, recorded(later) as other:
        row: Row = {"check": float(bool(said_by_check(session)))}
        for name, fitted in [("", False), ("_fitted", True)][: 1 if smoke else 2]:
            recipe = calib.Recipe(location=calib.PadEdge(), curve=calib.Linear(), folds=2, fit_electrodes=fitted)
            found = calib.calibrate([session], recipe=recipe)
            row |= {f"calibrate{name}": float(bool(noted(found.notes)))}
            row |= {f"{what}{name}": value for what, value in applied(found, other).items()}
    return row


def applied(found: calib.Calibration, session: calib.Session) -> Row:
    """Whether an application says it, and errors of the places of contacts and of loads, medians in mm."""
    with tempfile.TemporaryDirectory() as folder:
        path = calib.apply(found, session, Path(folder) / "maps.h5", loads=WINDOW, proposal=None)
        with open_archive(path, FORMAT) as file:
            outside = str(file.attrs.get("outside", "")).split("\n")
            time, place, misfit = (file.arrays[f"loads/{name}"].read() for name in ("time", "position", "misfit"))
    tried = calib.evaluate(found, session)
    presses = session.presses
    middle = time.mean(1)
    own = np.abs(middle[:, None] - 0.5 * (presses.t_hold0 + presses.t_hold1)).argmin(1)
    truth = np.stack([presses.x, presses.y], 1)[own]
    away = np.nan_to_num(np.linalg.norm(place - truth[:, None], axis=2), nan=np.inf).min(1)
    single = np.linalg.norm(tried.estimated["fitted"] - tried.position, axis=1)
    return {
        "apply": float(bool(noted(outside))),
        "contact_mm": 1e3 * float(np.median(single)),
        "load_mm": 1e3 * float(np.median(away)),
        "left": float(bool(left_by_fits(misfit))),
    }


def said_by_check(session: calib.Session) -> str:
    """What `jaxeit check` says of the places of the electrodes."""
    return said_by(check_session(session), session)


def said_by(report: CheckReport, session: calib.Session) -> str:
    """The same, by a report without it."""
    report = with_placement(report, session)
    return next((finding.what for finding in report.findings if finding.where == WHERE), "")


@contextmanager
def recorded(bench: oracle.Bench) -> Iterator[calib.Session]:
    """A session of the second simulator."""
    with tempfile.TemporaryDirectory() as folder:
        oracle.write(Path(folder) / "session.h5", oracle.simulate(bench))
        with calib.open_session(Path(folder) / "session.h5") as session:
            yield session


HONEST_SEED = 7500
QUICK = oracle.Bench(places=4, levels=(12.0,), spacing=3e-3)
HONEST = {
    "as usual": QUICK,
    "finer mesh": replace(QUICK, spacing=2e-3),
    "uneven coat, 15 %": replace(QUICK, faults=oracle.Faults(coating=0.15)),
    "uneven coat, 30 %": replace(QUICK, faults=oracle.Faults(coating=0.3)),
    "uneven coat, 45 %": replace(QUICK, faults=oracle.Faults(coating=0.45)),
    "tips as rings": replace(QUICK, faults=oracle.Faults(shape="ring")),
    "spheres of 10 mm": replace(QUICK, faults=oracle.Faults(shape="hertz", tip=0.01)),
    "a fifth of the noise": replace(QUICK, faults=oracle.Faults(noise=0.2)),
    "10 times the noise": replace(QUICK, faults=oracle.Faults(noise=10.0)),
    "30 times the noise": replace(QUICK, faults=oracle.Faults(noise=30.0)),
    "drift, ten times": replace(QUICK, faults=oracle.Faults(drift=10.0)),
    "temperature, 2 K": replace(QUICK, faults=oracle.Faults(temperature=2.0)),
}


def honest(run: Run) -> Iterator[Row]:
    """How many honest sessions are said to have misplaced electrodes, and the largest size that is found, in mm."""
    sizes = []
    for path in sorted((ROOT / "data" / "sessions").glob("*.h5")):
        with calib.open_session(path) as session:
            sizes.append(size_of(session))
    for scene in run.sizes(("hot_day", "sliding", "two_contacts", "chest_two_contacts"), ()):
        with tempfile.TemporaryDirectory() as folder, simulated(scene, Path(folder)) as session:
            sizes.append(size_of(session))
    for name, bench in run.sizes(list(HONEST.items()), []):
        for seed in range(HONEST_SEED, HONEST_SEED + 2):
            with recorded(replace(bench, skin_seed=seed, seed=seed)) as session:
                sizes.append(size_of(session))
            print(name, seed, sizes[-1], flush=True)
    said, size, evidence = np.array(sizes).T
    row = {"sessions": len(said), "said": float(said.sum()), "size_mm": size.max(), "evidence": evidence.max()}
    yield {"honest": [{name: round(float(value), 3) for name, value in row.items()}]}


def simulated(scene: str, folder: Path) -> calib.Session:
    """A session of a shipped scene, by the first simulator."""
    return calib.open_session(simulate(load_bench(scene), folder / "session.h5"))


def size_of(session: calib.Session) -> tuple[float, float, float]:
    """Whether something is said of a session, and size in mm and evidence of what is found."""
    report = check_session(session)
    channels = report.channels
    skin = je.skin.parse_skin(session.skin_toml, session.name)
    found = find_misplacement(je.discretise(je.Scene(skin), FIDELITY), np.where(channels.bad, np.nan, channels.mean))
    return float(bool(said_by(report, session))), 1e3 * float(found.size), float(found.evidence)


main = Question("electrodes", __doc__, {"calibrations": measure, "announced": announced, "honest": honest})

if __name__ == "__main__":
    main()
