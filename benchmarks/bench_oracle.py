"""What each fault of a bench costs, on sessions of the second simulator (tests/oracles/bench), not of `calib.bench`.

A session of 100 places at 5, 10 and 20 N is calibrated with `--location edge --curve polynomial`; another session of
the same skin (other places, order and noise) is predicted.  Rows of the first kind have the fault in both sessions.  In
rows of the second kind the calibration is that without faults, and only the predicted session has the fault.  Rows are
means over skins.

CV is that of estimated over true force, bias their mean ratio less one; `rmse_scaled_n` is the error that is left after
division by that ratio.  Coverage is the share of presses within their 90 % interval.

`weeks`: gains of the pads have moved by 6 %, levels at rest by 40 Pa, and the image has become 20 % stronger; the
calibration is moved by ten presses of known force, or by contacts of ordinary use.  Means over skins of other seeds.

`tracks`: contacts followed by `apply --track` at places that the calibration has not seen: with the tracker's own model
error, with that which the presses of the calibration show, and with a contact layer learned from 100 other presses.
"""

import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import norm

import calib
import jaxeit as je
from calib.calibration import Calibration, KnownForces, OrdinaryUse, learn_layer
from calib.calibration.application.map_files import FORCE_MAP_FORMAT, TRACKS
from calib.calibration.evaluation import Evaluation
from calib.calibration.localisation.contact_tracks import TRACK_ARRAYS
from calib.calibration.localisation.ellipses import INSIDE_90
from calib.fitting.cross_validation.scores import rmse
from calib.session import Session, open_archive
from tests.oracles.bench import Bench, Faults

from .harness import Question, Run
from .rows import Row, averaged, group_means, rounded
from .second_simulator import session_of

BOTH = {
    "none": Faults(),
    "crosstalk 2 %": Faults(crosstalk=0.02),
    "crosstalk 3 %": Faults(crosstalk=0.03),
    "crosstalk 10 %": Faults(crosstalk=0.1),
    "bolts misplaced, 1 mm": Faults(misplaced=1e-3),
    "bolts misplaced, 2 mm": Faults(misplaced=2e-3),
    "hysteresis 10 %": Faults(hysteresis=0.1),
    "creep 5 %": Faults(creep=0.05),
    "coating 15 %": Faults(coating=0.15),
    "protrusions 30 %": Faults(scatter=0.3),
    "drift, ten times": Faults(drift=10.0),
    "temperature, 2 K": Faults(temperature=2.0),
    "several": Faults(
        crosstalk=0.03, hysteresis=0.05, misplaced=1e-3, coating=0.15, creep=0.03, scatter=0.2, drift=3.0
    ),
}
LATER = {
    "ring": Faults(shape="ring"),
    "tilted": Faults(shape="tilted"),
    "ellipse": Faults(shape="ellipse"),
    "sphere": Faults(shape="hertz"),
    "10 mm tip": Faults(tip=0.01),
    "pads moved, 5 % and 50 Pa": Faults(moved_gain=0.05, moved_offset=50.0),
}
SKINS = (51, 52, 53, 54)
FULL, SMOKE = Bench(), Bench(places=16, levels=(10.0, 20.0), spacing=6e-3)
RECIPE = calib.Recipe(location=calib.PadEdge(), curve=calib.fitting.MonotonePolynomial())
DRAFT = replace(
    RECIPE, curve=calib.Linear(), fidelity=je.Fidelity.draft(), locator=calib.calibration.ImageCentroid(), folds=2
)


def measure(run: Run) -> Iterator[Row]:
    """A row for each fault, means over the skins."""
    bench, recipe = (SMOKE, DRAFT) if run.smoke else (FULL, RECIPE)
    benches = [replace(bench, skin_seed=seed) for seed in run.sizes(SKINS, SKINS[:1])]
    sound: list[Calibration] = []
    for name, faults in run.sizes(list(BOTH.items()), [("none", Faults())]):
        calibrations = [_calibrated(skin, faults, recipe) for skin in benches]
        sound = sound or calibrations
        yield _row(name, "both", calibrations, benches, faults)
    for name, faults in run.sizes(list(LATER.items()), []):
        yield _row(name, "the second", sound, benches, faults)


def _calibrated(bench: Bench, faults: Faults, recipe: calib.Recipe) -> Calibration:
    with _recorded(bench, faults, seed=bench.seed) as session:
        return calib.calibrate([session], recipe=recipe)


def _row(name: str, where: str, calibrations: list[Calibration], benches: list[Bench], faults: Faults) -> Row:
    each = [predicted(*pair, faults) for pair in zip(calibrations, benches, strict=True)]
    row = {"fault": name, "in": where} | averaged(each, sd_of="coverage") | {"skins": len(each)}
    print(row, flush=True)
    return {"rows": [row]}


def _recorded(bench: Bench, faults: Faults, seed: int) -> AbstractContextManager[Session]:
    return session_of(replace(bench, faults=faults, seed=seed))


def predicted(calibration: Calibration, bench: Bench, faults: Faults) -> Row:
    """Errors of place and force of a calibration on another session, rounded."""
    with _recorded(bench, faults, seed=2) as session:
        found = calib.evaluate(calibration, session)
    ratio = _ratio(found)
    row = {"rmse_n": rmse(found.total_force, found.force), "cv": ratio.std(ddof=1), "bias": ratio.mean() - 1}
    row["rmse_scaled_n"] = rmse(found.total_force / ratio.mean(), found.force)
    row |= {name: value for name, value in found.summary().items() if name.startswith("coverage")}
    for name, place in found.estimated.items():
        row[f"{name}_mm"] = 1e3 * float(np.linalg.norm(place - found.position, axis=1).mean())
    return rounded(row)


# --- a week later

WEEK = Faults(moved_gain=0.06, moved_offset=40.0, moved_layer=np.log(1.2))
PRESSES = {"after ten presses of known force": (10, (12.0,), KnownForces())} | {
    f"after {2 * places} contacts of ordinary use": (places, (8.0, 15.0), OrdinaryUse()) for places in (10, 30, 100)
}


def weeks(run: Run) -> Iterator[Row]:
    """Relative errors of forces at places that were not pressed, before and after each update, moved or not."""
    bench, recipe = (SMOKE, DRAFT) if run.smoke else (FULL, RECIPE)
    rows = []
    for seed in run.sizes(range(21, 27), (21,)):
        skin = replace(bench, skin_seed=seed)
        with _recorded(skin, Faults(), seed=1) as session:
            calibration = calib.calibrate([session], recipe=recipe)
        for moved, faults in (("yes", WEEK), ("no", Faults())):
            rows += [{"moved": moved} | row for row in updated(calibration, skin, faults, run.smoke)]
            print(rows[-1], flush=True)
    yield {"weeks": group_means(rows, "gains", "moved", count="skins")}


def updated(calibration: Calibration, bench: Bench, faults: Faults, smoke: bool) -> Iterator[Row]:
    """A row for each update of a calibration to sessions of a skin with these faults."""
    with _recorded(bench, faults, seed=2) as later:
        yield {"gains": "those of the calibration"} | _relative(calib.evaluate(calibration, later))
        for seed, (name, (places, levels, evidence)) in enumerate(list(PRESSES.items())[: 1 if smoke else None], 3):
            with _recorded(replace(bench, places=places, levels=levels), faults, seed=seed) as session:
                new = calib.recalibrate(calibration, session, evidence, ignore_errors=True)
            told = float(np.mean(new.recalibration.significant))
            yield {"gains": name} | _relative(calib.evaluate(new, later)) | {"pads_moved": told}


def _relative(found: Evaluation) -> Row:
    ratio = _ratio(found)
    spread = float(ratio.std(ddof=1) / ratio.mean())
    return {"rmse": rmse(ratio, np.ones_like(ratio)), "spread": spread, "coverage": found.summary()["coverage"]}


def _ratio(found: Evaluation) -> np.ndarray:
    """Estimated over true force, (presses,)."""
    return found.total_force / found.force


# --- contacts followed

FOLLOWED = {"as simulated": Faults(), "protrusions differ by 30 %": Faults(scatter=0.3)}
OTHER_TIPS = Bench(places=50, levels=(10.0,))


def tracks(run: Run) -> Iterator[Row]:
    """Followed contacts, for each preparation of the tracker: places, forces, coverage, and seconds that were none."""
    seeds = (31,) if run.smoke else (37, 38)
    rows = [row for seed in seeds for row in followed_on(seed, run)]
    yield {"tracks": group_means(rows, "skin", "model error", count="skins")}


def followed_on(seed: int, run: Run) -> Iterator[Row]:
    """The rows of one skin."""
    bench = SMOKE if run.smoke else replace(FULL, levels=(8.0, 16.0), places=60)
    skin, later = (replace(one, skin_seed=seed) for one in (bench, bench if run.smoke else OTHER_TIPS))
    for name, faults in run.sizes(list(FOLLOWED.items()), [("as simulated", Faults())]):
        with _recorded(skin, faults, seed=1) as session:
            calibration = calib.calibrate([session], recipe=DRAFT)
        ways = {"the tracker's own": replace(calibration, probes=None), "of the calibration's presses": calibration}
        places = skin.places if run.smoke else 100
        with _recorded(replace(skin, places=places, levels=(8.0,)), faults, seed=2) as session:
            try:
                ways["the same, layer learned"] = learn_layer(calibration, session)
            except calib.SessionError as error:
                print(error)
        with _recorded(later, faults, seed=3) as session:
            for way, one in ways.items():
                row = {"skin": name, "model error": way} | _followed(one, session)
                print(row, flush=True)
                yield row


def _followed(calibration: Calibration, session: Session) -> Row:
    """How contacts were followed in the holds of single presses; the force is that of the contact that is nearest."""
    with tempfile.TemporaryDirectory() as folder:
        path = calib.apply(calibration, session, Path(folder) / "maps.h5", track=True)
        with open_archive(path, FORCE_MAP_FORMAT) as file:
            found = {name: file.arrays[TRACKS + name].read() for name in TRACK_ARRAYS}
    presses, held = session.presses, []
    for begin, end, *truth in zip(
        presses.t_hold0, presses.t_hold1, presses.x, presses.y, presses.target_force, strict=True
    ):
        own = (found["time"] > begin) & (found["time"] < end)
        if own.any():
            held.append(_held({name: values[own] for name, values in found.items()}, *truth))
    table = {name: np.array([one[name] for one in held], float) for name in held[0]}
    return {
        "error_mm": float(table["error_mm"].mean()),
        "median_mm": float(np.median(table["error_mm"])),
        "p95_mm": float(np.quantile(table["error_mm"], 0.95)),
        "covered": float(table["covered"].mean()),
        "force_bias": float(np.median(table["force_error"])),
        "force_rms": float(np.sqrt(np.mean(table["force_error"] ** 2))),
        "force_covered": float(table["force_covered"].mean()),
        "false_seconds": float(table["several"].mean()),
        "missed": 1 - len(held) / len(presses.x),
    }


def _held(found: dict[str, np.ndarray], x: float, y: float, force: float) -> Row:
    """Errors of the rows of `tracks/...` in a hold; shares of them whose 90 % ellipses and intervals hold."""
    away = found["position"] - [x, y]
    square = np.einsum("ni,ni->n", away, np.linalg.solve(found["position_covariance"], away[..., None])[..., 0])
    distance, (_, frame) = np.linalg.norm(away, axis=1), np.unique(found["time"], return_inverse=True)
    nearest = [own[np.argmin(distance[own])] for own in (np.flatnonzero(frame == k) for k in range(frame.max() + 1))]
    error = found["force"][nearest] - force
    return {
        "error_mm": 1e3 * distance.mean(),
        "covered": (square < INSIDE_90**2).mean(),
        "force_error": error.mean() / force,
        "force_covered": (np.abs(error) < norm.ppf(0.95) * found["force_se"][nearest]).mean(),
        "several": len(nearest) < len(frame),
    }


main = Question("oracle", __doc__, {"rows": measure, "weeks": weeks, "tracks": tracks})

if __name__ == "__main__":
    main()
