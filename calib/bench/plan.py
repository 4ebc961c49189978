"""A simulated bench: an indenter walks over a skin and everything is recorded, as on a real one.

The mesh that simulates is not the mesh that `calib.calibrate` inverts with, so that neither knows
the other's discretisation error.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_OID, uuid5

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BarycentricInterpolator

import jaxeit as je

from .session import PressTable, SessionWriter

_LEVELS = 9  # force levels solved at per press; a Chebyshev interpolant joins them
_LARGEST = 2 << 30  # bytes of voltages that one simulated session may hold

Progress = Callable[[Iterable], Iterable]


class BenchError(ValueError):
    """A bench protocol that cannot be run."""


@dataclass(frozen=True)
class Timing:
    """One press, in seconds; the paper states 2 s of hold, the rest is assumed."""

    rest: float = 1.0
    ramp: float = 1.0
    hold: float = 2.0
    release: float = 1.0
    recovery: float = 1.5

    @property
    def period(self) -> float:
        """From the start of one press to the start of the next, s."""
        return self.rest + self.ramp + self.hold + self.release + self.recovery


@dataclass(frozen=True, eq=False)
class Bench:
    """A scene, the presses made on it, and how they are recorded.

    | meaning                                                     | shape      | unit |
    |-------------------------------------------------------------|------------|------|
    | sites: centres of the tip                                   | (sites, 2) | m    |
    | forces: what each press goes to, repeated over the sites    | (any,)     | N    |
    | tip_diameter                                                | ()         | m    |
    | blank: recording without contact at the start               | ()         | s    |
    | eit_rate, pad_rate: stored EIT frames; pressures and forces | ()         | Hz   |
    | eit_step, pressure_step, force_step: of the stored counts   | ()         | V, Pa, N |
    | seed of all noise                                           |            |      |
    | toml: the text that describes all this                      |            |      |
    """

    scene: je.Scene
    sites: np.ndarray
    forces: np.ndarray
    title: str = "simulated bench session"
    tip_diameter: float = 0.02
    timing: Timing = field(default_factory=Timing)
    blank: float = 60.0
    eit_rate: float = 180.0
    pad_rate: float = 200.0
    eit_step: float = 1e-6
    pressure_step: float = 1.0
    force_step: float = 0.01
    seed: int = 0
    epoch: datetime = datetime(2026, 1, 1, tzinfo=UTC)
    toml: str = ""

    def __post_init__(self):
        outside = ~self.scene.skin.domain.contains(self.sites)
        if outside.any():
            number = int(np.argmax(outside))
            raise BenchError(f"site {number} at {self.sites[number]} m lies outside the sheet")
        size = 8 * self.duration * self.eit_rate * self.scene.skin.protocol.readings
        if size > _LARGEST:
            raise BenchError(
                f"{self.duration:.0f} s at {self.eit_rate:g} frames per second would hold "
                f"{size / 2**30:.1f} GiB of voltages in memory; use fewer sites or a lower eit_rate"
            )

    @property
    def duration(self) -> float:
        """Of the whole recording, s."""
        return self.blank + len(self.sites) * self.timing.period

    @property
    def press_forces(self) -> np.ndarray:
        """What each press goes to, (sites,) N."""
        return np.resize(self.forces, len(self.sites))


def load_bench(path: str | Path) -> Bench:
    """A bench from a scene file (data/sessions holds two to copy).

    Raises:
        ValueError: naming the file, the key and the reason.
    """
    text = je.read_text(Path(path))
    return je.parse_toml(text, str(path), lambda table: _bench(table, text))


def _bench(top: je.TomlTable, text: str) -> Bench:
    top.choice("format", "jaxeit-scene")
    top.get("version", lambda v: v == 1, "1, the version this jaxeit reads")
    skin = je.load_skin(top.get("skin", lambda v: isinstance(v, str), "a skin's name or path"))
    title = top.get("title", lambda v: isinstance(v, str), "the session's title")
    seed = top.get("seed", lambda v: type(v) is int and 0 <= v < 2**31, "a whole number")
    effects = je.read_effects(top)
    table = top.table("bench")
    top.done()
    names = ("blank", "eit_rate", "pad_rate", "eit_step", "pressure_step", "force_step")
    numbers: dict[str, Any] = {n: table.positive(n, "a number") for n in names if table.has(n)}
    if table.has("tip_diameter"):
        numbers["tip_diameter"] = table.positive("tip_diameter", "a length in m")
    forces = table.array("forces", None, "[N, ...], what each press goes to")
    sites = _sites(table, skin.domain)
    times = [n for n in Timing.__dataclass_fields__ if table.has(n)]
    timing = Timing(**{n: table.positive(n, "s") for n in times})
    table.done()
    scene = je.Scene(skin, effects)
    return Bench(scene, sites, forces, title, timing=timing, seed=seed, toml=text, **numbers)


def _sites(table: je.TomlTable, domain) -> np.ndarray:
    if table.has("sites"):
        return table.array("sites", 2, "[[x, y], ...] in m")
    columns, rows = table.count("columns"), table.count("rows")
    margin = table.number("margin", "how near the tip's centre comes to the rim, m")
    (x0, y0), (x1, y1) = domain.bounds
    x = np.linspace(x0 + margin, x1 - margin, columns)
    y = np.linspace(y0 + margin, y1 - margin, rows)
    grid = np.stack(np.meshgrid(x, y), -1)
    return grid.reshape(-1, 2)


def simulate(
    bench: Bench,
    path: str | Path,
    *,
    fidelity: je.Fidelity | None = None,
    progress: Progress = iter,
) -> Path:
    """Run the bench and write its session file.

    Args:
        path: of the session; it appears only when complete.
        fidelity: of the simulation; default: finer than that of calibration.
        progress: wraps the iteration over presses, such as `tqdm.tqdm`.

    Raises:
        ValueError: if the scene cannot be discretised or the file not written.
    """
    fidelity = je.Fidelity(edge_length=0.02) if fidelity is None else fidelity
    model = je.discretise(bench.scene, fidelity)
    response = je.pad_response(bench.scene.skin, model)
    frames, samples = _clock(bench.duration, bench.eit_rate), _clock(bench.duration, bench.pad_rate)
    voltages = np.tile(np.asarray(je.forward(model)), (len(frames), 1))
    pressures = np.zeros((len(samples), len(bench.scene.skin.pads)))
    forces = np.zeros((len(samples), 1))
    sites = list(zip(bench.sites, bench.press_forces, strict=True))
    for number, (site, force) in enumerate(progress(sites)):
        start = bench.blank + number * bench.timing.period
        spread = je.load_spread(model, jnp.asarray(site), bench.tip_diameter)
        at, load = _profile(frames, start, bench.timing)
        voltages[at] = _voltages(model, spread, force, load)
        at, load = _profile(samples, start, bench.timing)
        forces[at, 0] = force * load
        pressures[at] = np.outer(force * load, response @ spread)
    streams = {"eit": voltages, "pressure": pressures, "force": forces}
    recorded = _read_out(bench, streams, {"eit": bench.eit_rate})
    return _write(bench, Path(path), frames, samples, recorded)


def _clock(duration: float, rate: float) -> np.ndarray:
    """Times of the samples, s."""
    return np.arange(int(duration * rate)) / rate


def _profile(times: np.ndarray, start: float, timing: Timing) -> tuple[slice, np.ndarray]:
    """Samples of the press that starts at ``start``, and their share of the full load, 0 to 1."""
    first, last = np.searchsorted(times, [start, start + timing.period])
    since = times[first:last] - start - timing.rest
    up = np.clip(since / timing.ramp, 0, 1)
    down = np.clip((since - timing.ramp - timing.hold) / timing.release, 0, 1)
    return slice(first, last), 0.5 * (np.cos(np.pi * down) - np.cos(np.pi * up))


def _voltages(model: je.Model, spread, force: float, load: np.ndarray) -> np.ndarray:
    """Frames at shares of the full load, from solves at Chebyshev points and the polynomial
    through them: the response is analytic in the load.  At 20 N nine points leave 3e-6 of the change
    for a load spread over 12 mm, 8e-5 over 8 mm, where the piezoresistance is nearer its limit."""
    levels = 0.5 * (1 + np.polynomial.chebyshev.chebpts1(_LEVELS))
    solved = np.asarray(_solve(model, spread, jnp.asarray(force * levels)))
    return BarycentricInterpolator(levels, solved)(load)


@eqx.filter_jit
def _solve(model, spread, forces):
    return jax.lax.map(lambda f: je.forward(model, je.conductivity(model, f * spread)), forces)


def _read_out(bench: Bench, streams: dict, rates: dict) -> dict:
    """The streams as the instruments see them, each with noise of its own."""
    keys = jax.random.split(jax.random.key(bench.seed), len(streams))
    out = {}
    for key, (name, series) in zip(keys, streams.items(), strict=True):
        interval = jnp.asarray(1 / rates.get(name, bench.pad_rate))
        effects = [e for e in bench.scene.effects if isinstance(e, je.AbstractReadoutEffect)]
        mine = [e for e in effects if e.stream == je.Stream(name)]
        out[name] = np.asarray(_disturb(mine, jnp.asarray(series), key, interval))
    return out


def _disturb(effects, series, key, interval):
    for number, effect in enumerate(sorted(effects, key=lambda e: e.rank)):
        one = jax.random.fold_in(key, number)
        series = je.fold([effect], je.AbstractReadoutEffect, series, one, interval)
    return series


def _write(bench: Bench, path: Path, frames, samples, recorded) -> Path:
    skin, protocol = bench.scene.skin, bench.scene.skin.protocol
    writer = SessionWriter(
        path,
        title=bench.title,
        skin_name=skin.name,
        skin_toml=skin.toml,
        pattern=protocol.pattern,
        current=protocol.current,
        frequency=protocol.frequency,
        offset=np.arange(protocol.readings) * protocol.reading_time,
        epoch=bench.epoch,
        simulated=True,
        scene=bench.toml,
        seed=bench.seed,
        session_id=str(uuid5(NAMESPACE_OID, f"{bench.toml}{bench.seed}")),
        license="Apache-2.0",
    )
    with writer:
        for name, variable, units, rate, step in (
            ("eit", "voltage", "V", bench.eit_rate, bench.eit_step),
            ("pressure", "pressure", "Pa", bench.pad_rate, bench.pressure_step),
            ("force", "force", "N", bench.pad_rate, bench.force_step),
        ):
            times = _nanoseconds(frames if name == "eit" else samples)
            channels = recorded[name].shape[1]
            writer.add_stream(
                name,
                variable,
                units=units,
                channels=channels,
                rate_hz=rate,
                dtype="i2",
                scale_factor=step,
                transport="simulated",
            )
            writer.append(name, times, recorded[name])
        writer.set_presses(_presses(bench))
        writer.set_truth({"contact_position": (bench.sites, "m")})
    return path


def _presses(bench: Bench) -> PressTable:
    timing, count = bench.timing, len(bench.sites)
    start = bench.blank + np.arange(count) * timing.period + timing.rest
    after = np.cumsum([0, timing.ramp, timing.hold, timing.release])
    press, hold0, hold1, release = (_nanoseconds(start + t) for t in after)
    return PressTable(
        x=bench.sites[:, 0],
        y=bench.sites[:, 1],
        tip_diameter=np.full(count, bench.tip_diameter),
        target_force=bench.press_forces,
        t_press=press,
        t_hold0=hold0,
        t_hold1=hold1,
        t_release=release,
        pad=_pad_under(bench),
        accepted=np.ones(count, bool),
        reason=("",) * count,
    )


def _pad_under(bench: Bench) -> np.ndarray:
    pads = [je.Polygon(pad.outline).contains(bench.sites) for pad in bench.scene.skin.pads]
    inside = np.array(pads).reshape(len(pads), len(bench.sites))
    return np.where(inside.any(0), inside.argmax(0), -1) if len(pads) else np.full(len(inside), -1)


def _nanoseconds(seconds: np.ndarray) -> np.ndarray:
    return np.rint(seconds * 1e9).astype(np.int64)
