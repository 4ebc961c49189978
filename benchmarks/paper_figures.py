"""The paper's figures 5, 6 and 8 for both skins, SIMULATED, into docs/figures: SKIN-places, -sensitivity, -contacts.

Figures 5 and 6 show a calibration of the bench (scenes `paper_bench` and `chest_bench`): true and estimated places, and
sensitivity over the sheet.

Figure 8 shows two contacts that come and go one by one: force over time, its error, and interference.  Its scenes
(`two_contacts` and `chest_two_contacts`): press 1, press 2, release 1, release 2, some with both tips on one pad, the
others on neighbouring ones.  The calibration is of single presses on a grid over the same sheet, as a bench makes them:
it has seen no second contact.  A contact's force is that of the contact that was followed there (`apply --track`).

moving: the same for contacts that move (scenes `sliding` and `rolling`, on the testbed): place and force over time of
one stroke each, and errors over all strokes, in frames in which the tip has half of its load or more.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.bench.motion import loads_at, planned_motion
from calib.calibration import Calibration
from calib.report.figures.force_series import ForceSeries, force_series_figure
from calib.report.figures.moving_contact import WITHIN, Stroke, moving_contact_figure
from calib.report.figures.parts import write_figure
from calib.report.figures.presses import localisation_figure, sensitivity_figure
from calib.report.figures.skin.curved_sheet import curved_figure
from calib.runtime import set_up

from .harness import ROOT, Question, Run
from .rows import Row

PICTURES = ROOT / "docs" / "figures"
SCENES = {"testbed": ("paper_bench", "two_contacts"), "chest": ("chest_bench", "chest_two_contacts")}
MOVING = {"sliding": "a tip drawn 50 mm over the sheet in 2 s", "rolling": "a roller, 24 mm long, rolled 40 mm in 2 s"}
SIDE, MARGIN = 9, 0.01  # of the grid of presses that figure 8 is calibrated on; m
CASES = ("two contacts on one pad", "a contact on each of two pads")
EVENTS = ("press 1", "press 2", "release 1", "release 2")
FOUND = ("localisation_quarter_mean", "localisation_fitted_mean", "cv_eit_ddof1", "cv_hybrid_ddof1", "force_rmse")


def measure(run: Run) -> Iterator[Row]:
    fidelity = je.Fidelity.draft() if run.smoke else je.Fidelity.standard()
    for skin, (bench, contacts) in run.sizes(list(SCENES.items()), list(SCENES.items())[:1]):
        with tempfile.TemporaryDirectory() as folder:
            figures, row = bench_figures(load_bench(bench), Path(folder), fidelity, run.smoke)
            forces = force_map(load_bench(contacts), Path(folder), fidelity, run.smoke)
        figures["contacts"], errors = contact_figure(load_bench(contacts), forces)
        for name, figure in {} if run.smoke else figures.items():
            write_figure(figure, PICTURES / f"{skin}-{name}.png")
        yield {"bench": [{"skin": skin} | row], "contacts": [{"skin": skin} | one for one in errors]}


def calibrated(path: Path, fidelity: je.Fidelity) -> Calibration:
    with calib.open_session(path) as session:
        return calib.calibrate([session], recipe=calib.Recipe(location=calib.PadEdge(), fidelity=fidelity))


def bench_figures(bench: Bench, folder: Path, fidelity: je.Fidelity, smoke: bool) -> tuple[Row, Row]:
    """Figures 5 and 6 from a calibration of the scene, and its errors."""
    if smoke:
        bench = replace(bench, sites=bench.sites[::4], eit_rate=10.0, pad_rate=20.0, blank=5.0)
    calibration = calibrated(simulate(bench, folder / "bench.h5", fidelity=fidelity), fidelity)
    found, sheet = calibration.evaluation, calibration.skin
    figures: Row = {
        "places": localisation_figure(found, sheet, "quarter", "fitted", simulated=True),
        "sensitivity": sensitivity_figure(found, sheet, simulated=True),
    }
    if sheet.surface is not None:
        figures["curved"] = curved_figure(calibration, "fitted")
    return figures, {name: round(float(found.summary()[name]), 4) for name in FOUND}


def force_map(bench: Bench, folder: Path, fidelity: je.Fidelity, smoke: bool) -> dict[str, np.ndarray]:
    """What `calib.apply` writes of the scene, by a calibration of single presses on a grid over the same sheet, to
    forces as large as both tips have together."""
    ends = np.transpose(bench.scene.skin.domain.bounds)
    x, y = (np.linspace(low + MARGIN, high - MARGIN, 4 if smoke else SIDE) for low, high in ends)
    changes: Row = {"companions": (), "slide": (0.0, 0.0), "forces": np.array([25.0]), "tip_diameter": 0.02}
    changes |= {"eit_rate": 10.0, "toml": "", "seed": bench.seed + 1}
    alone = replace(bench, sites=np.stack(np.meshgrid(x, y), -1).reshape(-1, 2), **changes)
    calibration = calibrated(simulate(alone, folder / "alone.h5", fidelity=fidelity), fidelity)
    bench = replace(bench, eit_rate=10.0) if smoke else bench
    with calib.open_session(simulate(bench, folder / "pair.h5", fidelity=fidelity)) as session:
        calib.apply(calibration, session, folder / "map.h5", track=True)
    return dict(calib.session.read_archive(folder / "map.h5", "skin-forcemap").arrays)


def contact_figure(bench: Bench, forces: dict[str, np.ndarray]) -> tuple[Figure, list[Row]]:
    """Figure 8: the first press with both tips on one pad, and the first with a tip on each of two; and the errors of
    the contacts' forces, N."""
    tips = planned_motion(bench).places[: len(bench.sites)]  # (presses, 2, 2)
    skin, pairs = bench.scene.skin, tips.reshape(-1, 2)
    inside = skin.pads_at(pairs).reshape(-1, len(tips), 2)
    away = np.reshape([pad.polygon.boundary_distance(pairs) for pad in skin.pads], (-1, len(tips), 2))
    under = inside.argmax(0)  # (presses, 2)
    within = (away.min(0) > 1e-6).all(1)  # else a tip rests on pads beside the one that its centre is on
    same = under[:, 0] == under[:, 1]
    firsts = [int(np.flatnonzero(within & kind)[0]) for kind in (same, ~same)]
    cases = [series(title, bench, forces, number, under[number]) for title, number in zip(CASES, firsts, strict=True)]
    rmse = [float(np.sqrt(np.mean((one.estimated - one.true)[:, :2] ** 2))) for one in cases]
    errors = [{"case": title, "rmse_n": round(error, 3)} for title, error in zip(CASES, rmse, strict=True)]
    return force_series_figure(cases, simulated=True), errors


def series(title: str, bench: Bench, forces: dict[str, np.ndarray], number: int, under: np.ndarray) -> ForceSeries:
    """Forces of the two contacts of a press, and of the pads that are not touched, over its time."""
    start, every, motion = bench.blank + number * bench.period, forces["time"] / 1e9, planned_motion(bench)
    rows = (every >= start + 0.5) & (every < start + bench.period - 0.2)
    place, share = (part[rows] for part in by_frame(forces))
    far = np.linalg.norm(place[:, :, None] - motion.places[number], axis=-1)
    there, nearest = np.isfinite(far).all(-1), np.argmin(np.nan_to_num(far, nan=np.inf), -1)
    followed = np.stack([np.where(there & (nearest == tip), share, 0).sum(1) for tip in (0, 1)], 1)
    others = np.delete(forces["pad_force"][rows], under, 1).sum(1)
    timing, late = bench.timing, bench.companions[0].delay
    down = timing.rest + timing.ramp + timing.hold
    events = dict(zip(EVENTS, (timing.rest, timing.rest + late, down, down + late), strict=True))
    names = ("contact 1", "contact 2", "pads not touched, together")
    true = np.column_stack([loads_at(motion, every[rows]).load, 0 * others])
    return ForceSeries(title, names, every[rows] - start, true, np.column_stack([followed, others]), events)


def by_frame(forces: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, K, 2) m and forces (n, K) N of the contacts that are followed in each frame; NaN: none."""
    frame = np.searchsorted(forces["time"], forces["tracks/time"])
    column = np.arange(len(frame)) - np.searchsorted(frame, frame)
    place = np.full((len(forces["time"]), max(column, default=0) + 1, 2), np.nan)
    force = np.zeros(place.shape[:2])
    place[frame, column], force[frame, column] = forces["tracks/position"], forces["tracks/force"]
    return place, force


# --- contacts that move


def measure_moving(run: Run) -> Iterator[Row]:
    fidelity = je.Fidelity.draft() if run.smoke else je.Fidelity.standard()
    shown, rows = [], []
    for name, title in run.sizes(list(MOVING.items()), list(MOVING.items())[1:]):
        bench = load_bench(name)
        with tempfile.TemporaryDirectory() as folder:
            forces = force_map(bench, Path(folder), fidelity, run.smoke)
        strokes = [stroke(title, bench, forces, number) for number in range(len(bench.sites))]
        shown.append(strokes[0])
        rows.append({"scene": name, "strokes": len(strokes)} | errors_of(strokes))
    if not run.smoke:
        write_figure(moving_contact_figure(shown, simulated=True), PICTURES / "testbed-moving.png")
    yield {"moving": rows}


def stroke(title: str, bench: Bench, forces: dict[str, np.ndarray], number: int) -> Stroke:
    """A press of a bench with a slide, and the strongest contact that is followed in each frame of it; places from
    where it begins."""
    motion, start = planned_motion(bench), bench.blank + number * bench.period
    every = forces["time"] / 1e9
    rows = (every >= start + 0.2) & (every < start + bench.period - 0.2)
    load = loads_at(motion, every[rows])
    slide = np.array(bench.slide)
    tips = motion.places[number] + load.progress[..., None] * slide
    share = load.load / np.maximum(load.load.sum(1, keepdims=True), 1e-9)
    along = slide / np.linalg.norm(slide)
    axes = np.stack([along, [-along[1], along[0]]])
    first = motion.places[number].mean(0)
    true = np.column_stack([1e3 * (np.einsum("tk,tkd->td", share, tips) - first) @ axes.T, load.load.sum(1)])
    true[true[:, 2] == 0, :2] = np.nan
    place, covariance, force, error = (part[rows] for part in strongest(forces))
    turned = np.einsum("ai,nij,aj->na", axes, covariance, axes)
    estimated = np.column_stack([1e3 * (place - first) @ axes.T, force])
    return Stroke(title, every[rows] - start, true, estimated, np.column_stack([1e3 * np.sqrt(turned), error]))


def strongest(forces: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Place (n, 2), its covariance (n, 2, 2), force (n,) and its error (n,) of the strongest contact of each frame."""
    frame = np.searchsorted(forces["time"], forces["tracks/time"])
    order = np.argsort(forces["tracks/force"], kind="stable")  # the strongest is written last
    found = []
    for name in ("position", "position_covariance", "force", "force_se"):
        part = forces[f"tracks/{name}"]
        out = np.full((len(forces["time"]), *part.shape[1:]), np.nan)
        out[frame[order]] = part[order]
        found.append(out)
    return tuple(found)


def errors_of(strokes: list[Stroke]) -> Row:
    """Root mean squares of the errors of place and force, and how many places an ellipse's axes of 90 % hold."""
    true, estimated, deviation = (
        np.concatenate([getattr(one, name) for one in strokes]) for name in ("true", "estimated", "deviation")
    )
    pressed = true[:, 2] >= 0.5 * np.nanmax(true[:, 2])
    followed = pressed & np.isfinite(estimated).all(1)
    off = (estimated - true)[followed]
    inside = np.abs(off) < WITHIN * deviation[followed]
    return {
        "followed": float(followed.sum() / pressed.sum()),
        "place_rms_mm": round(float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, 1)))), 3),
        "force_rmse_n": round(float(np.sqrt(np.mean(off[:, 2] ** 2))), 3),
        "along_covered": float(inside[:, 0].mean()),
        "across_covered": float(inside[:, 1].mean()),
        "force_covered": float(inside[:, 2].mean()),
    }


PARTS = {"figures": measure, "moving": measure_moving}
main = Question("paper_figures", __doc__, PARTS, prepare=set_up)

if __name__ == "__main__":
    main()
