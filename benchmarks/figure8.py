"""Two contacts that come and go one by one, as in the paper's figure 8: force over time, its error, and interference.

The shipped scene `two_contacts` (SIMULATED): press 1, press 2, release 1, release 2, three times with both tips on one
pad and on neighbouring ones otherwise.  The calibration is of single presses on a grid over the same sheet, as a bench
makes them: it has seen no second contact.  A contact's force is its share of the pads' forces by its fitted bump, and
beside it that of the force map's pixels nearest to it.  A pad's true force is that of the tips above it, so that what
spreads to its neighbours counts as interference; it means nothing for tips that stand on a border of pads.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.bench.motion import loads_at, planned_motion
from calib.report.figures import write_figure
from calib.report.force_series import ForceSeries, force_series_figure
from calib.runtime import set_up

from .harness import ROOT, Question, Row, Run

PICTURE = ROOT / "docs" / "figure-8.png"
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
    contact_position (n, K, 2) m, contact_force (n, K) N."""
    fidelity = je.Fidelity.draft() if smoke else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        grid = simulate(alone(bench, smoke), folder / "alone.h5", fidelity=fidelity)
        pair = simulate(bench, folder / "pair.h5", fidelity=fidelity)
        with calib.open_session(grid) as session:
            calibration = calib.calibrate([session], recipe=calib.Recipe(location=calib.PadEdge(), fidelity=fidelity))
        with calib.open_session(pair) as session:
            calib.apply(calibration, session, folder / "map.h5")
        return dict(calib.session.read_archive(folder / "map.h5", "skin-forcemap").arrays)


@dataclass(frozen=True, eq=False)
class Press:
    """One press of both tips: what they did, and what the force map says of that time."""

    bench: Bench
    forces: dict[str, np.ndarray]
    number: int

    @property
    def start(self) -> float:
        return self.bench.blank + self.number * self.bench.period

    @cached_property
    def rows(self) -> np.ndarray:
        time = self.forces["time"] / 1e9
        return (time >= self.start + 0.5) & (time < self.start + self.bench.period - 0.2)

    @cached_property
    def time(self) -> np.ndarray:
        """(n,) s."""
        return self.forces["time"][self.rows] / 1e9

    @property
    def tips(self) -> np.ndarray:
        """(contacts, 2) m."""
        return planned_motion(self.bench).places[self.number]

    @cached_property
    def contacts(self) -> np.ndarray:
        """(n, contacts) N, the true forces."""
        return loads_at(planned_motion(self.bench), self.time).load

    @property
    def under(self) -> np.ndarray:
        """Pad under each tip."""
        return np.argmax([je.Polygon(pad.outline).contains(self.tips) for pad in self.bench.scene.skin.pads], 0)

    @property
    def pads(self) -> np.ndarray:
        """(n, pads) N, the true forces."""
        true = np.zeros((len(self.time), len(self.bench.scene.skin.pads)))
        np.add.at(true.T, self.under, self.contacts.T)
        return true

    @property
    def by_fit(self) -> np.ndarray:
        """(n, contacts) N, of the contacts that were fitted."""
        return self._to_tips(self.forces["contact_position"][self.rows], self.forces["contact_force"][self.rows])

    @property
    def by_map(self) -> np.ndarray:
        """(n, contacts) N, of the pixels of the force map."""
        force = self.forces["force"][self.rows]
        return self._to_tips(np.broadcast_to(self.forces["centres"], (*force.shape, 2)), force)

    def _to_tips(self, place: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Forces (n, k) at places (n, k, 2), each given to the nearest tip, (n, contacts); NaN is nowhere."""
        far = np.linalg.norm(place[:, :, None] - self.tips, axis=-1)
        nearest = np.argmin(np.nan_to_num(far, nan=np.inf), -1)
        force = np.where(np.isfinite(far).all(-1), force, 0)
        return (force[..., None] * (nearest[..., None] == np.arange(len(self.tips)))).sum(1)

    @property
    def kind(self) -> str:
        """One of `KINDS`; a tip on a border rests on pads beside the one that its centre is on."""
        pads, under = self.bench.scene.skin.pads, self.under
        outlines = [je.Polygon(pads[k].outline) for k in under]
        away = [one.boundary_distance(tip[None])[0] for one, tip in zip(outlines, self.tips, strict=True)]
        return KINDS[2] if min(away) < 1e-6 else KINDS[len(set(under.tolist())) - 1]

    def row(self) -> Row:
        true, found, contacts = self.pads, self.forces["pad_force"][self.rows], self.contacts
        idle, both = ~true.any(0), (contacts > 0.9 * contacts.max(0)).all(1)
        off, hold = found.sum(1) - true.sum(1), true.sum(1)[both].mean()
        return {
            "press": self.number,
            "tips_on": self.kind,
            "pad_rmse_N": _rms((found - true)[:, ~idle]),
            "contact_rmse_N": _rms(self.by_fit - contacts),
            "map_contact_rmse_N": _rms(self.by_map - contacts),
            "total_rmse_N": _rms(off),
            "total_error_of_hold_percent": float(100 * np.abs(off[both]).mean() / hold),
            "interference_percent": float(100 * np.abs(found[both][:, idle]).max(0).max() / hold),
        }

    def series(self, title: str) -> ForceSeries:
        idle = sorted(set(range(len(self.bench.scene.skin.pads))) - set(self.under.tolist()))
        others = self.forces["pad_force"][self.rows][:, idle].sum(1, keepdims=True)
        timing, late = self.bench.timing, self.bench.companions[0].delay
        down = timing.rest + timing.ramp + timing.hold
        events = dict(zip(EVENTS, (timing.rest, timing.rest + late, down, down + late), strict=True))
        names = ("contact 1", "contact 2", "pads not touched, together")
        true, found = np.column_stack([self.contacts, np.zeros(len(self.time))]), np.column_stack([self.by_fit, others])
        return ForceSeries(title, names, self.time - self.start, true, found, events)


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def summary(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Means by kind."""
    found: dict[str, Any] = {kind: [row for row in rows if row["tips_on"] == kind] for kind in KINDS}
    return {
        kind: {key: round(float(np.mean([row[key] for row in mine])), 3) for key in list(mine[0])[2:]}
        for kind, mine in found.items()
        if mine
    }


def measure(run: Run) -> Iterator[Row]:
    bench = load_bench("two_contacts")
    bench = replace(bench, eit_rate=10.0, blank=2.0) if run.smoke else bench
    forces = force_map(bench, run.smoke)
    presses = [Press(bench, forces, number) for number in range(len(bench.sites))]
    rows = [press.row() for press in presses]
    yield {"rows": rows, "summary": summary(rows), "grid": SIDE}
    if not run.smoke:
        firsts = [next(press for press in presses if press.kind == kind) for kind in KINDS[:2]]
        cases = [press.series(title) for press, title in zip(firsts, CASES, strict=True)]
        write_figure(force_series_figure(cases, simulated=True), PICTURE)


main = Question("figure8", __doc__, {"rows": measure}, prepare=set_up)

if __name__ == "__main__":
    main()
