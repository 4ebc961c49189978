"""One session of presses: skin, faults and stage put together to the streams that a bench records."""

from dataclasses import dataclass, field, replace

import numpy as np

from . import contact, motion, pads
from .faults import Faults
from .mesh import make_mesh
from .motion import Presses
from .sheet import Sheet, green, make_sheet, mean_potentials, readings, touched
from .skin import Skin, read_skin

EIT_RATE, PAD_RATE, SLOW_RATE = 5.0, 20.0, 1.0


@dataclass(frozen=True)
class Bench:
    """What is simulated: the skin's own seed and the session's, places, force levels (N), spacing of the mesh (m)."""

    faults: Faults = field(default_factory=Faults)
    skin_seed: int = 1
    seed: int = 1
    places: int = 100
    levels: tuple[float, ...] = (5.0, 10.0, 20.0)
    spacing: float = 2.5e-3


@dataclass(frozen=True, eq=False)
class Session:
    """A recording: presses, and for each stream its rate in Hz, unit and samples (times, channels)."""

    bench: Bench
    skin: Skin
    presses: Presses
    streams: dict[str, tuple[float, str, np.ndarray]]


def simulate(bench: Bench = Bench()) -> Session:
    """Simulate a session; the same ``skin_seed`` and faults give the same skin."""
    skin, rng = read_skin(), np.random.default_rng([bench.seed, 7])
    presses = motion.plan(skin.size, bench.places, list(bench.levels), rng)
    own = np.random.default_rng([bench.skin_seed, 11])
    bolts = skin.bolts + bench.faults.misplaced * own.standard_normal(skin.bolts.shape)
    layer = contact.make_layer(skin, bolts, bench.faults.scatter, own)
    layer = replace(layer, gain=layer.gain * np.exp(bench.faults.moved_layer))
    cells = pads.make_pads(len(skin.pads), bench.faults.crosstalk, own)
    mesh = make_mesh(skin, bolts, bench.spacing)
    sheet = make_sheet(mesh, coating(mesh.points[mesh.triangles].mean(1), bench.faults.coating, own) / skin.resistance,
                       skin.contact)  # fmt: skip
    loads = press_shares(layer, presses, bench.faults)
    end = motion.duration(presses)
    streams = {
        "eit": (EIT_RATE, "V", _eit(bench, skin, presses, layer, sheet, loads, end, rng)),
        "pressure": (PAD_RATE, "Pa", _pressure(bench, skin, presses, layer, cells, loads, end, rng)),
        "force": (PAD_RATE, "N", _force(bench, presses, end, rng)),
        "stage": (PAD_RATE, "m", _stage(bench, presses, end, rng)),
    }
    if bench.faults.temperature:
        kelvin = 295 + _warmth(bench, _times(end, SLOW_RATE)) + 0.02 * rng.standard_normal(len(_times(end, SLOW_RATE)))
        streams["temperature"] = (SLOW_RATE, "K", kelvin[:, None])
    return Session(bench, skin, presses, streams)


def coating(places: np.ndarray, spread: float, rng: np.random.Generator, length: float = 0.03) -> np.ndarray:
    """Log-normal random field at places (n, 2): many plane waves of random direction and phase, mean about one."""
    waves = rng.standard_normal((200, 2)) / length
    phase = rng.uniform(0, 2 * np.pi, 200)
    return np.exp(spread * np.sqrt(2 / 200) * np.cos(places @ waves.T + phase).sum(1))


def press_shares(layer: contact.Layer, presses: Presses, faults: Faults) -> np.ndarray:
    """Share of each press's force on each patch, (presses, patches)."""
    each = zip(presses.places, presses.forces, strict=True)
    return np.array([contact.shares(layer, place, faults.shape, faults.tip, force) for place, force in each])


def _times(end: float, rate: float) -> np.ndarray:
    return np.arange(int(end * rate)) / rate


def transfer_frames(layer: contact.Layer, sheet: Sheet, loads: np.ndarray) -> np.ndarray:
    """Transfer matrix of the bolts for each frame of loads (frames, patches), ohm."""
    return transfers(layer, sheet, contact.conductances(layer, loads))


def transfers(layer: contact.Layer, sheet: Sheet, conducts: np.ndarray) -> np.ndarray:
    """Transfer matrix of the bolts for each frame of conductances (frames, patches) S, ohm."""
    live = conducts.any(0)
    if not live.any():
        return np.broadcast_to(sheet.untouched, (len(conducts), *sheet.untouched.shape))
    chosen = contact.Layer(layer.places[live], layer.island[live], layer.touch[live], layer.gain[live])
    between, bolts = green(sheet, mean_potentials(sheet.mesh, contact.samples(chosen)))
    found = np.empty((len(conducts), *sheet.untouched.shape))
    for k, g in enumerate(conducts[:, live]):
        on = np.flatnonzero(g)
        joined = contact.joined(g[on], chosen.island[on])
        found[k] = touched(sheet, between[np.ix_(on, on)], bolts[on], joined)
    return found


def _eit(bench, skin, presses, layer, sheet, shares, end, rng) -> np.ndarray:
    times = _times(end, EIT_RATE)
    moment = motion.moments(presses, times)
    older = 1 + bench.faults.creep * np.log10(1 + np.maximum(moment.since, 0) / 0.1)
    # Frames of one press at one force are alike: each is solved once.  The force is zero between presses.
    state = np.column_stack([np.where(moment.force, moment.press, 0), np.round(moment.force * older, 9)])
    alike, which = np.unique(state, axis=0, return_inverse=True)
    transfer = transfer_frames(layer, sheet, shares[alike[:, 0].astype(int)] * alike[:, 1:])
    volts = np.array([readings(each, skin.pattern, skin.current) for each in transfer])[which]
    wander = 1e-4 * bench.faults.drift * np.sqrt(1 / EIT_RATE) * rng.standard_normal(len(times)).cumsum()
    gain = (1 + wander) * (1 - 2e-3 * _warmth(bench, times))
    return volts * gain[:, None] + 1.7e-6 * bench.faults.noise * rng.standard_normal(volts.shape)


def _pressure(bench, skin, presses, layer, cells, shares, end, rng) -> np.ndarray:
    faults, times = bench.faults, _times(end, PAD_RATE)
    moment = motion.moments(presses, times)
    held = shares @ pads.load_matrix(skin, layer.places).T  # (presses, pads)
    load = held[np.maximum(moment.press, 0)] * moment.force[:, None]
    load = pads.late(pads.yielding(load, faults.hysteresis), PAD_RATE, faults.creep)
    step = 0.3 * faults.drift * np.sqrt(1 / PAD_RATE)  # 0.3 Pa after a second, 18 Pa after an hour
    slow = pads.warmed(_warmth(bench, times), PAD_RATE)[:, None] + step * rng.standard_normal(load.shape).cumsum(0)
    later = np.random.default_rng([bench.skin_seed, 13])
    moved = pads.Pads(
        cells.gain * np.exp(faults.moved_gain * later.standard_normal(len(cells.gain))),
        cells.offset + faults.moved_offset * later.standard_normal(len(cells.gain)),
        cells.mixing,
    )
    return pads.sensed(moved, pads.cell_pressure(load) + slow, 5.0 * faults.noise * rng.standard_normal(load.shape))


def _force(bench, presses, end, rng) -> np.ndarray:
    force = motion.moments(presses, _times(end, PAD_RATE)).force[:, None]
    return 0.01 * np.round((force + 0.01 * bench.faults.noise * rng.standard_normal(force.shape)) / 0.01)


def _stage(bench, presses, end, rng) -> np.ndarray:
    place = motion.stage(presses, motion.moments(presses, _times(end, PAD_RATE)))
    return place + 2e-5 * bench.faults.noise * rng.standard_normal(place.shape)


def _warmth(bench: Bench, times: np.ndarray) -> np.ndarray:
    """Temperature above that of the start, K: a swing of twenty minutes."""
    return bench.faults.temperature * np.sin(2 * np.pi * times / 1200)
