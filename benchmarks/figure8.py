"""Two contacts that come and go one by one, as in the paper's figure 8: force over time, its error, and interference.

python -m benchmarks.figure8 [--smoke]

The shipped scene `two_contacts` (SIMULATED): press 1, press 2, release 1, release 2, three times with both tips on one
pad and on neighbouring ones otherwise.  The calibration is of single presses on a grid over the same sheet, as a bench
makes them: it has seen no second contact.  A contact's force is its share of the pads' forces by its fitted bump, and
beside it that of the force map's pixels nearest to it.  A pad's true force is that of the tips above it, so that what
spreads to its neighbours counts as interference; it means nothing for tips that stand on a border of pads.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, load_bench, simulate
from calib.bench.motion import moments, planned
from calib.figures import ForceSeries, force_series_figure, write_figure
from calib.runtime import set_up

from . import _common as c

PICTURE = c.ROOT / "docs" / "figure-8.png"
SIDE = 9  # of the grid of presses that are calibrated on
MARGIN = 0.01  # m
KINDS = ("one pad", "two pads", "a border of pads")
EVENTS = ("press 1", "press 2", "release 1", "release 2")


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="coarse, few presses; writes nothing")
    args = parser.parse_args(argv)
    set_up()
    before, scene = c.circumstances(), load_bench("two_contacts")
    scene = _coarse(scene) if args.smoke else scene
    with tempfile.TemporaryDirectory() as folder:
        forces = _forces(scene, Path(folder), args.smoke)
    rows = [_figures(scene, forces, press) for press in range(len(scene.sites))]
    data = {"rows": rows, "summary": _summary(rows), "grid": SIDE, "circumstances": before}
    print(table(rows))
    print(data["summary"])
    if not args.smoke:
        c.write("figure8", c.closed(data))
        cases = [_series(scene, forces, press, title) for press, title in _cases(rows)]
        write_figure(force_series_figure(cases, simulated=True), PICTURE)
    return data


def _coarse(bench: Bench) -> Bench:
    return replace(bench, eit_rate=10.0, blank=2.0)


def _alone(bench: Bench, smoke: bool) -> Bench:
    """Single presses on a grid over the same sheet, to forces as large as both tips have together."""
    x, y = (
        np.linspace(low + MARGIN, high - MARGIN, 4 if smoke else SIDE)
        for low, high in np.transpose(bench.scene.skin.domain.bounds)
    )
    sites = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return replace(
        bench, companions=(), sites=sites, forces=np.array([25.0]), eit_rate=10.0, toml="", seed=bench.seed + 1
    )


class Forces(dict[str, np.ndarray]):
    """What `calib.apply` writes: time (n,) s, force (n, pixels) N, pad_force (n, pads) N, centres (pixels, 2) m,
    contact_position (n, K, 2) m, contact_force (n, K) N."""


def _forces(bench: Bench, folder: Path, smoke: bool) -> Forces:
    fidelity = je.Fidelity.draft() if smoke else None
    grid = simulate(_alone(bench, smoke), folder / "alone.h5", fidelity=fidelity)
    pair = simulate(bench, folder / "pair.h5", fidelity=fidelity)
    with calib.open_session(grid) as session:
        calibration = calib.calibrate([session], location=calib.PadEdge(), fidelity=fidelity)
    with calib.open_session(pair) as session:
        calib.apply(calibration, session, folder / "map.h5")
    arrays = calib.read_archive(folder / "map.h5", "skin-forcemap").arrays
    kept = ("force", "pad_force", "centres", "contact_position", "contact_force")
    return Forces({name: arrays[name] for name in kept} | {"time": arrays["time"] / 1e9})


def _during(bench: Bench, forces: Forces, press: int) -> np.ndarray:
    start = bench.blank + press * bench.period
    return (forces["time"] >= start + 0.5) & (forces["time"] < start + bench.period - 0.2)


def _tips(bench: Bench, press: int) -> np.ndarray:
    return planned(bench).places[press]


def _pads_under(bench: Bench, press: int) -> np.ndarray:
    """Pad under each tip."""
    inside = [je.Polygon(pad.outline).contains(_tips(bench, press)) for pad in bench.scene.skin.pads]
    return np.argmax(inside, 0)


def _by_contact(bench: Bench, forces: Forces, press: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each contact over a press, (n, contacts) N: true force, that of the fit's contacts, that of the map."""
    rows, tips = _during(bench, forces, press), _tips(bench, press)
    true = moments(planned(bench), forces["time"][rows]).load
    centres = np.broadcast_to(forces["centres"], (len(true), *forces["centres"].shape))
    shared = _to_tips(tips, forces["contact_position"][rows], forces["contact_force"][rows])
    return true, shared, _to_tips(tips, centres, forces["force"][rows])


def _to_tips(tips: np.ndarray, place: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Forces (n, k) at places (n, k, 2), each given to the nearest tip, (n, contacts); NaN is nowhere."""
    far = np.linalg.norm(place[:, :, None] - tips, axis=-1)
    nearest = np.argmin(np.nan_to_num(far, nan=np.inf), -1)
    force = np.where(np.isfinite(far).all(-1), force, 0)
    return (force[..., None] * (nearest[..., None] == np.arange(len(tips)))).sum(1)


def _by_pad(bench: Bench, forces: Forces, press: int) -> tuple[np.ndarray, np.ndarray]:
    rows, under = _during(bench, forces, press), _pads_under(bench, press)
    load = moments(planned(bench), forces["time"][rows]).load
    true = np.zeros((len(load), len(bench.scene.skin.pads)))
    np.add.at(true.T, under, load.T)
    return true, forces["pad_force"][rows]


def _figures(bench: Bench, forces: Forces, press: int) -> dict[str, Any]:
    pads, found = _by_pad(bench, forces, press)
    contacts, shared, mapped = _by_contact(bench, forces, press)
    idle, both = ~pads.any(0), (contacts > 0.9 * contacts.max(0)).all(1)
    total = pads.sum(1)
    return {
        "press": press,
        "tips_on": _where(bench, press),
        "pad_rmse_N": _rms((found - pads)[:, ~idle]),
        "contact_rmse_N": _rms(shared - contacts),
        "map_contact_rmse_N": _rms(mapped - contacts),
        "total_rmse_N": _rms(found.sum(1) - total),
        "total_error_of_hold_percent": float(100 * np.abs((found.sum(1) - total)[both]).mean() / total[both].mean()),
        "interference_percent": float(100 * np.abs(found[both][:, idle]).max(0).max() / total[both].mean()),
    }


def _where(bench: Bench, press: int) -> str:
    """One of `KINDS`; a tip on a border rests on pads beside the one that its centre is on."""
    under, tips = _pads_under(bench, press), _tips(bench, press)
    pads = bench.scene.skin.pads
    if min(je.Polygon(pads[k].outline).boundary_distance(t[None])[0] for k, t in zip(under, tips, strict=True)) < 1e-6:
        return KINDS[2]
    return KINDS[0] if len(set(under.tolist())) == 1 else KINDS[1]


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _summary(rows: list[dict]) -> dict[str, dict[str, float]]:
    numbers = [key for key in rows[0] if key not in ("press", "tips_on")]
    found = {kind: [row for row in rows if row["tips_on"] == kind] for kind in KINDS}
    return {
        kind: {key: round(float(np.mean([row[key] for row in mine])), 3) for key in numbers}
        for kind, mine in found.items()
        if mine
    }


def _cases(rows: list[dict]) -> list[tuple[int, str]]:
    """The first press of each kind."""
    one, two = (next(row["press"] for row in rows if row["tips_on"] == kind) for kind in KINDS[:2])
    return [(one, "two contacts on one pad"), (two, "a contact on each of two pads")]


def _series(bench: Bench, forces: Forces, press: int, title: str) -> ForceSeries:
    rows, start = _during(bench, forces, press), bench.blank + press * bench.period
    true, found, _ = _by_contact(bench, forces, press)
    idle = sorted(set(range(len(bench.scene.skin.pads))) - set(_pads_under(bench, press).tolist()))
    others = forces["pad_force"][rows][:, idle].sum(1, keepdims=True)
    timing, late = bench.timing, bench.companions[0].delay
    down = timing.rest + timing.ramp + timing.hold
    events = dict(zip(EVENTS, (timing.rest, timing.rest + late, down, down + late), strict=True))
    return ForceSeries(
        title,
        ("contact 1", "contact 2", "pads not touched, together"),
        forces["time"][rows] - start,
        np.column_stack([true, np.zeros(len(true))]),
        np.column_stack([found, others]),
        events,
    )


def table(rows: list[dict]) -> str:
    """Markdown."""
    keys = [key for key in rows[0] if key not in ("press", "tips_on")]
    lines = [
        "| press | tips on | " + " | ".join(key.replace("_", " ") for key in keys) + " |",
        "|---" * (2 + len(keys)) + "|",
    ]
    for row in rows:
        lines.append(f"| {row['press']} | {row['tips_on']} | " + " | ".join(f"{row[key]:.2f}" for key in keys) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
