"""The paper's figures 5, 6 and 8 for both skins, SIMULATED, into docs/figures: SKIN-places, -sensitivity, -contacts;
and contacts that slide over the testbed: testbed-sliding.

Figures 5 and 6 show a calibration of the bench (scenes `paper_bench` and `chest_bench`): true and estimated places, and
sensitivity over the sheet.

Figure 8 shows two contacts that come and go one by one: force over time, its error, and interference.  Its scenes
(`two_contacts` and `chest_two_contacts`): press 1, press 2, release 1, release 2, some with both tips on one pad, the
others on neighbouring ones.  The calibration is of single presses on a grid over the same sheet, as a bench
makes them: it has seen no second contact.  A contact's force is that of the contact that was followed there
(`apply --track`); beside it its share of the pads' forces by its fitted bump, and that of the force map's pixels
nearest to it.  A pad's true force is that of the tips above it, so that what spreads to its neighbours counts as
interference; it means nothing for tips that stand on a border of pads.

Sliding contacts (scene `sliding`, every third stroke): paths and forces as they are followed, beside the true ones.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.bench.motion import loads_at, planned_motion
from calib.calibration.localisation.contact_tracks import ABOUT, Rows
from calib.report.curved_figure import curved_figure
from calib.report.figures import localisation_figure, sensitivity_figure, write_figure
from calib.report.force_series import ForceSeries, force_series_figure
from calib.report.track_report import tracks_figure
from calib.runtime import set_up

from .harness import ROOT, Question, Run
from .rows import Row, grouped

PICTURES = ROOT / "docs" / "figures"
SCENES = {"testbed": ("paper_bench", "two_contacts"), "chest": ("chest_bench", "chest_two_contacts")}
SIDE = 9  # of the grid of presses that are calibrated on
MARGIN = 0.01  # m
KINDS = ("one pad", "two pads", "a border of pads")
CASES = ("two contacts on one pad", "a contact on each of two pads")
EVENTS = ("press 1", "press 2", "release 1", "release 2")


def alone(bench: Bench, smoke: bool) -> Bench:
    """Single presses on a grid over the same sheet, to forces as large as both tips have together."""
    x, y = (
        np.linspace(low + MARGIN, high - MARGIN, 4 if smoke else SIDE)
        for low, high in np.transpose(bench.scene.skin.domain.bounds)
    )
    sites = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    changes: Row = {"companions": (), "forces": np.array([25.0]), "eit_rate": 10.0, "toml": "", "seed": bench.seed + 1}
    return replace(bench, sites=sites, **changes)


def force_map(bench: Bench, smoke: bool) -> dict[str, np.ndarray]:
    """What `calib.apply` writes: time (n,) ns, force (n, pixels) N, pad_force (n, pads) N, centres (pixels, 2) m,
    contact_position (n, K, 2) m, contact_force (n, K) N; and contacts that are followed, tracks/..."""
    fidelity = je.Fidelity.draft() if smoke else je.Fidelity.standard()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        grid = simulate(alone(bench, smoke), folder / "alone.h5", fidelity=fidelity)
        pair = simulate(bench, folder / "pair.h5", fidelity=fidelity)
        with calib.open_session(grid) as session:
            calibration = calib.calibrate([session], recipe=calib.Recipe(location=calib.PadEdge(), fidelity=fidelity))
        with calib.open_session(pair) as session:
            calib.apply(calibration, session, folder / "map.h5", track=True)
        return dict(calib.session.read_archive(folder / "map.h5", "skin-forcemap").arrays)


def by_frame(forces: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, K, 2) m and forces (n, K) N of the contacts that are followed in each frame; NaN: none."""
    frame = np.searchsorted(forces["time"], forces["tracks/time"])
    place = np.arange(len(frame)) - np.searchsorted(frame, frame)
    position = np.full((len(forces["time"]), max(place, default=0) + 1, 2), np.nan)
    force = np.zeros(position.shape[:2])
    position[frame, place], force[frame, place] = forces["tracks/position"], forces["tracks/force"]
    return position, force


class Press:
    """One press of both tips: what they did, and what the force map says of that time.

    | meaning                                                          | shape         | unit |
    |------------------------------------------------------------------|---------------|------|
    | time; rows: of the force map                                     | (n,)          | s    |
    | tips                                                             | (contacts, 2) | m    |
    | contacts: true forces; by_track: of the contacts followed;       | (n, contacts) | N    |
    | by_fit: of the contacts that were fitted;                        | (n, contacts) | N    |
    | by_map: of the pixels of the force map                           | (n, contacts) | N    |
    | under: pad under each tip                                        | (contacts,)   |      |
    | pads: true forces; found: those of the force map                 | (n, pads)     | N    |
    """

    def __init__(self, bench: Bench, forces: dict[str, np.ndarray], number: int) -> None:
        self.bench, self.number, self.start = bench, number, bench.blank + number * bench.period
        every, motion = forces["time"] / 1e9, planned_motion(bench)
        rows = (every >= self.start + 0.5) & (every < self.start + bench.period - 0.2)
        self.time, self.found, force = every[rows], forces["pad_force"][rows], forces["force"][rows]
        self.tips, self.contacts = motion.places[number], loads_at(motion, every[rows]).load
        self.outlines = [je.Polygon(pad.outline) for pad in bench.scene.skin.pads]
        self.under = np.argmax([outline.contains(self.tips) for outline in self.outlines], 0)
        self.pads = np.zeros(self.found.shape)
        np.add.at(self.pads.T, self.under, self.contacts.T)
        self.by_track = self._to_tips(*(part[rows] for part in by_frame(forces)))
        self.by_fit = self._to_tips(forces["contact_position"][rows], forces["contact_force"][rows])
        self.by_map = self._to_tips(np.broadcast_to(forces["centres"], (*force.shape, 2)), force)

    def _to_tips(self, place: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Forces (n, k) at places (n, k, 2), each given to the nearest tip, (n, contacts); NaN is nowhere."""
        far = np.linalg.norm(place[:, :, None] - self.tips, axis=-1)
        nearest = np.argmin(np.nan_to_num(far, nan=np.inf), -1)
        force = np.where(np.isfinite(far).all(-1), force, 0)
        return (force[..., None] * (nearest[..., None] == np.arange(len(self.tips)))).sum(1)

    @property
    def kind(self) -> str:
        """One of `KINDS`; a tip on a border rests on pads beside the one that its centre is on."""
        pressed = zip(self.under, self.tips, strict=True)
        away = [self.outlines[pad].boundary_distance(tip[None])[0] for pad, tip in pressed]
        return KINDS[2] if min(away) < 1e-6 else KINDS[len(set(self.under.tolist())) - 1]

    def row(self) -> Row:
        idle, both = ~self.pads.any(0), (self.contacts > 0.9 * self.contacts.max(0)).all(1)
        off, hold = self.found.sum(1) - self.pads.sum(1), self.pads.sum(1)[both].mean()
        return {
            "press": self.number,
            "tips_on": self.kind,
            "pad_rmse_N": _rms((self.found - self.pads)[:, ~idle]),
            "followed_rmse_N": _rms(self.by_track - self.contacts),
            "contact_rmse_N": _rms(self.by_fit - self.contacts),
            "map_contact_rmse_N": _rms(self.by_map - self.contacts),
            "total_rmse_N": _rms(off),
            "total_error_of_hold_percent": float(100 * np.abs(off[both]).mean() / hold),
            "interference_percent": float(100 * np.abs(self.found[both][:, idle]).max(0).max() / hold),
        }

    def series(self, title: str) -> ForceSeries:
        others = np.delete(self.found, self.under, 1).sum(1)
        timing, late = self.bench.timing, self.bench.companions[0].delay
        down = timing.rest + timing.ramp + timing.hold
        events = dict(zip(EVENTS, (timing.rest, timing.rest + late, down, down + late), strict=True))
        names = ("contact 1", "contact 2", "pads not touched, together")
        true, found = (np.column_stack(parts) for parts in ((self.contacts, 0 * others), (self.by_track, others)))
        return ForceSeries(title, names, self.time - self.start, true, found, events)


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def summary(rows: Sequence[Row]) -> dict[str, Row]:
    """Means by kind."""
    by_kind = grouped(rows, "tips_on")
    return {
        kind: {key: round(float(np.mean([row[key] for row in by_kind[kind]])), 3) for key in list(rows[0])[2:]}
        for kind in KINDS
        if kind in by_kind
    }


def measure(run: Run) -> Iterator[Row]:
    for skin, (bench, contacts) in run.sizes(list(SCENES.items()), list(SCENES.items())[:1]):
        single = bench_figures(skin, bench, run.smoke)
        rows = contact_figure(skin, contacts, run.smoke)
        slides = slide_figure(smoke=run.smoke) if skin == "testbed" else []
        means = [{"skin": skin, "tips_on": kind} | row for kind, row in summary(rows).items()]
        rows = [{"skin": skin} | row for row in rows]
        yield {"bench": [{"skin": skin} | single], "contacts": means, "rows": rows, "sliding": slides}


def bench_figures(skin: str, scene: str, smoke: bool) -> Row:
    """Figures 5 and 6 from a calibration of the scene, and its errors."""
    bench = load_bench(scene)
    bench = replace(bench, sites=bench.sites[::4], eit_rate=10.0, pad_rate=20.0, blank=5.0) if smoke else bench
    fidelity = je.Fidelity.draft() if smoke else je.Fidelity.standard()
    with tempfile.TemporaryDirectory() as folder:
        path = simulate(bench, Path(folder) / "bench.h5", fidelity=fidelity)
        with calib.open_session(path) as session:
            recipe = calib.Recipe(location=calib.PadEdge(), fidelity=fidelity)
            calibration = calib.calibrate([session], recipe=recipe)
    found, sheet = calibration.evaluation, calibration.skin
    figures = {
        "places": localisation_figure(found, sheet, "quarter", "fitted", simulated=True),
        "sensitivity": sensitivity_figure(found, sheet, simulated=True),
    }
    if sheet.surface is not None:
        figures["curved"] = curved_figure(calibration, "fitted")
    if not smoke:
        for name, figure in figures.items():
            write_figure(figure, PICTURES / f"{skin}-{name}.png")
    names = ("localisation_quarter_mean", "localisation_fitted_mean", "cv_eit_ddof1", "cv_hybrid_ddof1", "force_rmse")
    return {name: round(float(value), 4) for name, value in found.summary().items() if name in names}


def contact_figure(skin: str, scene: str, smoke: bool) -> list[Row]:
    """Figure 8, and a row for each press of both tips."""
    bench = load_bench(scene)
    bench = replace(bench, eit_rate=10.0, blank=2.0) if smoke else bench
    forces = force_map(bench, smoke)
    presses = [Press(bench, forces, number) for number in range(len(bench.sites))]
    if not smoke:
        firsts = [next(press for press in presses if press.kind == kind) for kind in KINDS[:2]]
        cases = [press.series(title) for press, title in zip(firsts, CASES, strict=True)]
        write_figure(force_series_figure(cases, simulated=True), PICTURES / f"{skin}-contacts.png")
    return [press.row() for press in presses]


def slide_figure(*, smoke: bool) -> list[Row]:
    """The figure of contacts that slide, and a row for each stroke."""
    bench = load_bench("sliding")
    sites, rate = (bench.sites[:1], 20.0) if smoke else (bench.sites[::3], bench.eit_rate)
    bench = replace(bench, sites=sites, eit_rate=rate, blank=2.0)
    forces, motion = force_map(bench, smoke), planned_motion(bench)
    state = loads_at(motion, forces["time"] / 1e9)
    position = motion.places[state.press] + np.array(bench.slide) * state.progress[..., None]
    true = {"time": forces["time"], "position": position, "force": state.load}
    tracks = {name: forces[f"tracks/{name}"] for name in ABOUT}
    if not smoke:
        write_figure(
            tracks_figure(tracks, bench.scene.skin, true=true, simulated=True), PICTURES / "testbed-sliding.png"
        )
    frame = np.searchsorted(forces["time"], tracks["time"])
    return [_stroke(number, tracks, true, frame, state.press[frame] == number) for number in range(len(sites))]


def _stroke(number: int, tracks: Rows, true: Rows, frame: np.ndarray, mine: np.ndarray) -> Row:
    """Errors of a stroke while at least 2 N press, and how many contacts were seen in it."""
    press = mine & (true["force"][frame, 0] > 2)
    away = np.linalg.norm(tracks["position"] - true["position"][frame, 0], axis=1)[press]
    return {
        "stroke": number,
        "numbers": len(set(tracks["number"][press].tolist())),
        "place_mean_mm": float(1e3 * away.mean()) if len(away) else None,
        "force_rmse_N": _rms((tracks["force"] - true["force"][frame, 0])[press]) if len(away) else None,
    }


main = Question("paper_figures", __doc__, {"rows": measure}, prepare=set_up)

if __name__ == "__main__":
    main()
