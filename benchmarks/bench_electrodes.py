"""What misplaced electrodes cost a calibration, and what of that `calibrate --fit-electrodes` wins back.

The scene of the bundled session is simulated on skins whose bolts are drilled aside by 1.1 mm (standard deviation, in x
and in y), for seeds that nothing was chosen by. Each session is calibrated three times: by the skin's file, which knows
nothing of that; by the same file with the electrodes fitted; and by the skin as it is, the bound. Rows are means over
the seeds. "stated": what the fit itself says that its places err by, from the posterior of the untouched frame and the
presses; "within": share of the coordinates that lie in their 90 % interval by these standard errors.

announced: skins of the second simulator (`tests/oracles/bench`), on which nothing was tuned, whose bolts sit aside by
so much in each direction (standard deviation). "said": share of untouched frames that `check`, `calibrate` and `apply`
announce, which ask the same function; "found": the median size that it tells. On some of these skins: median error of
the place of single contacts, and of the strongest load by fits, with the places of the file and with those fitted to
the untouched frame and nine presses.

honest: sessions of skins whose electrodes sit where the file says: bundled ones, shipped scenes, and those of the
second simulator with other coats, tips and noise. None should be announced.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.calibration.localisation.electrode_places import PlacedElectrodes
from calib.calibration.localisation.load_windows import LOAD_FIDELITY
from calib.check import check_session
from calib.check.electrodes import ELECTRODE_FIDELITY
from calib.check.placement import PLACEMENT_FIDELITY, WHERE, placement_finding, with_placement
from calib.check.report import CheckReport
from calib.fitting.intervals import NORMAL_MULTIPLE
from jaxeit.imaging import KnownPresses, find_misplacement, fit_electrodes
from tests.oracles import bench as oracle

from .harness import ROOT, Question, Run
from .rows import Row, group_means, rounded
from .second_simulator import Wear, presses, recorded, session_of

SCENE = ROOT / "data" / "sessions" / "testbed_grid.toml"
MISPLACED = 1.1e-3  # m
FIRST_SEED = 60
FILED, FITTED, TRUE = "as the file says", "fitted", "as they sit"


def measure(run: Run) -> Iterator[Row]:
    bench, skin, rows = load_bench(str(SCENE)), je.load_skin("testbed"), []
    for seed in range(FIRST_SEED, FIRST_SEED + run.sizes(4, 1)):
        shift = np.random.default_rng(seed).normal(scale=MISPLACED, size=skin.electrode_positions.shape)
        there = je.skin.with_positions(skin, skin.electrode_positions + shift)
        rows += list(calibrated(bench, skin, there, run.sizes((FILED, FITTED, TRUE), (FILED, TRUE))))
        print(f"seed {seed}", flush=True)
    yield {"rows": group_means(rows, "electrodes", count="skins")}


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
                **stated(found.electrodes, off),
                "place_mm": 1e3 * float(place.mean()),
                "p95_mm": 1e3 * float(np.percentile(place, 95)),
                "force_n": float(found.evaluation.summary()["force_rmse"]),
            }


def stated(placed: PlacedElectrodes | None, off: np.ndarray) -> Row:
    """What a fit of the electrodes says that its places err by, and how often they do; None without a fit."""
    if placed is None:
        return {"stated_mm": None, "within": None}
    error = placed.standard_error
    return {
        "stated_mm": 1e3 * float(np.sqrt(np.mean(error**2))),
        "within": float(np.mean(np.abs(off) < NORMAL_MULTIPLE * error)),
    }


# --- what announces it

ASIDE = (0.0, 0.5e-3, 1e-3, 2e-3, 3e-3)  # m
ANNOUNCED_SEED = 7400
NOISE = 1e-3 / np.sqrt(20)  # of a mean of twenty frames, 60 dB below the readings
LOADS = 4  # presses whose loads are fitted


def announced(run: Run) -> Iterator[Row]:
    """Skins whose bolts sit aside: how many are announced, and what it costs without and with fitted electrodes."""
    frames, skins, known, later = run.sizes((20, 2, 9, 12), (1, 1, 2, 1))
    skin, seeds = je.load_skin("testbed"), range(ANNOUNCED_SEED, ANNOUNCED_SEED + frames)
    model, asked = (je.discretise(je.Scene(skin), fidelity) for fidelity in (LOAD_FIDELITY, PLACEMENT_FIDELITY))
    for aside in run.sizes(ASIDE, ASIDE[-1:]):
        rows = []
        for seed in seeds:
            fits = seed - ANNOUNCED_SEED < skins
            drilled = Drilled(seed, aside, *((known, later) if fits else (1, 0)))
            found = find_misplacement(asked, drilled.untouched)
            row = {"said": float(drilled.said(skin)), "found_mm": 1e3 * float(found.size)}
            rows.append(row | (drilled.errors(skin, model, run.smoke) if fits else {}))
            print(aside, seed, rows[-1], flush=True)
        yield {"announced": [{"aside_mm": 1e3 * aside, "frames": frames, "skins": skins} | summary(rows, rows[:skins])]}


def summary(every: list[Row], fitted: list[Row]) -> Row:
    """Shares that are announced, and medians, rounded."""
    found = {"said": np.mean([row["said"] for row in every]), "found_mm": np.median([row["found_mm"] for row in every])}
    found["said_fitted"] = np.mean([row["said_fitted"] for row in fitted])
    for name in filter(lambda name: "place" in name, fitted[0]):
        found[name] = np.median([each for row in fitted for each in row[name]])
    return rounded(found, 3)


class Drilled:
    """A skin of the second simulator whose bolts sit aside: its untouched frame, presses at known places and others."""

    def __init__(self, seed: int, aside: float, known: int, later: int):
        rng = np.random.default_rng([seed, 5])
        self.presses, self.known = presses(rng, known + later), known
        seen = recorded(seed, self.presses, Wear(misplaced=aside))
        self.noise = NOISE * np.sqrt(np.mean(seen.untouched**2))
        self.untouched = seen.untouched + self.noise * rng.normal(size=seen.untouched.shape)
        self.change = seen.change + self.noise * rng.normal(size=seen.change.shape)

    def said(self, skin: je.Skin) -> bool:
        """Whether `check`, `calibrate` and `apply` announce it: all of them ask this."""
        return placement_finding(skin, self.untouched, np.ones(len(self.untouched), bool)) is not None

    def errors(self, skin: je.Skin, model: je.Model, smoke: bool) -> Row:
        """Errors of places of presses that were not fitted, mm, with the places of the file and with fitted ones."""
        known = slice(self.known)
        place = np.concatenate([press.places for press in self.presses])
        noise = np.full(len(self.untouched), self.noise)
        given = KnownPresses(self.change[known], place[known], noise)
        fit = (
            None if smoke else fit_electrodes(je.discretise(je.Scene(skin), ELECTRODE_FIDELITY), self.untouched, given)
        )
        moved = skin.electrode_positions + (0 if fit is None else np.asarray(fit.shift))
        there = je.skin.with_positions(skin, moved)
        fitted = je.discretise(je.Scene(there), LOAD_FIDELITY)
        row = dict(self._told(model, place, noise, ""))
        row |= dict(self._told(fitted, place, noise, "_fitted"))
        return row | {"said_fitted": float(self.said(there))}

    def _told(
        self, model: je.Model, place: np.ndarray, noise: np.ndarray, way: str
    ) -> Iterator[tuple[str, list[float]]]:
        """Errors of places of the presses after the known ones, mm, by contacts and by loads."""
        sheet, one = je.fit_background(model, self.untouched), je.contacts.ContactSettings(most=1)
        single = je.prepare_contacts(model, one, noise=noise, sigma=sheet)
        later, true = self.change[self.known :], place[self.known :]
        away = np.linalg.norm(np.asarray(single(later).position)[:, 0] - true, axis=1)
        yield f"place{way}_mm", list(1e3 * away)
        fitter = je.contacts.prepare_loads(model, noise=noise, sigma=sheet)
        finder = je.prepare_contacts(model, noise=noise, sigma=sheet)
        loads = [fitter(frame, finder(frame)).best for frame in later[:LOADS]]
        nearest = [
            np.nan if load is None else np.linalg.norm(np.asarray(load.position)[load.force.argmax()] - at)
            for load, at in zip(loads, true, strict=False)
        ]
        yield f"load_place{way}_mm", [1e3 * float(one) for one in nearest if np.isfinite(one)]


def said_by(report: CheckReport, session: calib.Session) -> str:
    """What `jaxeit check` says of the places of the electrodes, whose report is given without that."""
    report = with_placement(report, session)
    return next((finding.what for finding in report.findings if finding.where == WHERE), "")


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
        with tempfile.TemporaryDirectory() as folder:
            path = simulate(load_bench(scene), Path(folder) / "session.h5")
            with calib.open_session(path) as session:
                sizes.append(size_of(session))
    for name, bench in run.sizes(list(HONEST.items()), []):
        for seed in range(HONEST_SEED, HONEST_SEED + 2):
            with session_of(replace(bench, skin_seed=seed, seed=seed)) as session:
                sizes.append(size_of(session))
            print(name, seed, sizes[-1], flush=True)
    said, size, evidence = np.array(sizes).T
    row = {"sessions": len(said), "said": float(said.sum()), "size_mm": size.max(), "evidence": evidence.max()}
    yield {"honest": [rounded(row, 3)]}


def size_of(session: calib.Session) -> tuple[float, float, float]:
    """Whether something is said of a session, and size in mm and evidence of what is found."""
    report = check_session(session)
    channels = report.channels
    skin = je.skin.parse_skin(session.skin_toml, session.name)
    found = find_misplacement(
        je.discretise(je.Scene(skin), PLACEMENT_FIDELITY), np.where(channels.bad, np.nan, channels.mean)
    )
    return float(bool(said_by(report, session))), 1e3 * float(found.size), float(found.evidence)


main = Question("electrodes", __doc__, {"calibrations": measure, "announced": announced, "honest": honest})

if __name__ == "__main__":
    main()
