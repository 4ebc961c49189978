"""Scans designed over all four-terminal readings, verified by fits of contacts.

Single presses of 8 N by a 20 mm tip at places all over the testbed, simulated on another mesh than the one on which
scans are designed and contacts found; every reading of all scans has the same noise, 60 dB (and once more 50 dB) below
the rms of the shipped scan's readings; three draws of it. "Exact": fits of the frames without noise, with the weights
of 60 dB: what is left is the error of the fit's model. "Bound": the mean error that `place_sensitivity` expects at
the sites of the design, over the whole sheet, for contacts of 25 %, a width of 12 mm and a model error of 1.5 %; the
presses are 15 mm or more from the rim. "Dead": readings of one electrode are left out, of the one that costs most.

`floor` asks where the errors without noise come from: the same presses fitted as bumps on two meshes and as loads
through the law of pressure, and presses on a contact layer whose gain is uneven by 12 % over 15 mm, unknown to the fit.
"""

from collections.abc import Callable, Iterator
from functools import partial
from time import perf_counter, process_time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from .harness import Question, Run
from .problems import pressed
from .rows import Row

COUNTS = (20, 40, 100, 275, 550)
DEAD = (100, 550)  # readings of a scan of which each electrode is taken away
LOUD = (
    10**0.5
)  # a second noise over the first: 50 dB below the readings, where the model of the fit errs less than noise
DRAWS = 3  # of noise
COLUMNS, UNSEEN = (3, 4, 6, 8, 12), 11  # sites along x of designs, and of those that judge them
LOAD = 8.0  # N
MARGIN, PRESSES, SEED = 0.015, 120, 2030
GAIN, GAIN_LENGTH = 0.12, 0.015  # of the contact layer, and m, in `floor`
EVERY_OTHER = 2  # of the presses, those that are fitted as loads
GREEDY, DESIGNED, CAREFUL = "D-optimal among the adjacent", "designed", "designed for a dead electrode"


class Bench:
    """Presses as all four-terminal readings see them, and what finds contacts in some of these.

    | meaning                                          | shape                 | unit |
    |--------------------------------------------------|-----------------------|------|
    | every: all four-terminal readings                | (candidates, 4)       |      |
    | sites of the presses                             | (presses, 2)          | m    |
    | change of all readings by the presses            | (presses, candidates) | V    |
    | noise of a reading                               | ()                    | V    |
    | order: rows of the shipped scan, the best first  | (readings,)           |      |
    """

    def __init__(self, smoke: bool) -> None:
        self.skin, self.smoke = je.load_skin("testbed"), smoke
        self.every = je.skin.all_pairs(len(self.skin.electrodes))
        rng, presses = np.random.default_rng(SEED), 4 if smoke else PRESSES
        low, high = self.skin.domain.bounds
        self.sites = rng.uniform(np.add(low, MARGIN), np.subtract(high, MARGIN), (presses, 2))
        self.change = self.pressed(())
        self.model = je.discretise(je.Scene(self.skin), je.Fidelity.draft())
        self.noise = 1e-3 * float(jnp.sqrt(jnp.mean(je.forward(self.model) ** 2)))
        settings = je.scan.DesignSettings(noise=self.noise, columns=4 if smoke else 8)
        self.sensitivity = je.scan.place_sensitivity(self.model, settings)
        signal = je.scan.signal_covariance(self.model, basis=je.Pixels(20).on(self.model))
        self.order = np.asarray(je.scan.choose_readings(signal, len(signal)).rows)
        self.place = {tuple(row): index for index, row in enumerate(self.every.tolist())}

    def pressed(self, effects: tuple) -> np.ndarray:
        """Change of all readings by the presses, (presses, candidates) V, on a skin with these effects."""
        loads = np.full((len(self.sites), 1), LOAD)
        whole, edge = je.skin.with_rows(self.skin, self.every), 0.06 if self.smoke else 0.026
        return pressed(effects, self.sites[:, None], loads, edge, skin=whole).change

    def seen(self, pattern: np.ndarray, change: np.ndarray) -> np.ndarray:
        """What a scan reads of the presses, less the untouched skin, without noise, (presses, readings) V."""
        pairs = np.sort(pattern.reshape(-1, 2, 2), 2)
        swap = (pairs[:, 0, 0] > pairs[:, 1, 0])[:, None, None]
        rows = np.where(swap, pairs[:, ::-1], pairs).reshape(-1, 4)
        sign = np.where((pattern[:, 0] > pattern[:, 1]) ^ (pattern[:, 2] > pattern[:, 3]), -1, 1)
        return np.asarray(sign * change[:, [self.place[tuple(row)] for row in rows.tolist()]])

    def row(self, way: str, pattern: np.ndarray, seconds: float | None = None) -> Row:
        """Errors of the contacts fitted to a scan, beside the bound."""
        model = self.model_of(pattern, je.Fidelity.standard())
        bound = 1e3 * np.asarray(self.sensitivity.errors(pattern))
        out: Row = {"way": way, "readings": len(pattern), "drives": len(np.unique(np.sort(pattern[:, :2], 1), axis=0))}
        out |= {"frames_per_s": 1 / (len(pattern) * self.skin.protocol.reading_time), "design_s": seconds}
        out |= {
            "bound_mm": float(bound.mean()),
            "bound_worst_mm": float(bound.max()),
            "dead_mm": None,
            "dead_fit_mm": None,
        }
        quiet, change = self.finder(model, 1.0), self.seen(pattern, self.change)
        out |= self.errors(self.fitted(quiet, change, 0.0), "exact") | self.errors(self.fitted(quiet, change), "fit")
        out |= self.errors(self.fitted(self.finder(model, LOUD), change, LOUD), "loud")
        if len(pattern) in DEAD or self.smoke:
            dead = [float(jnp.mean(self.sensitivity.errors(pattern, e))) for e in range(len(self.skin.electrodes))]
            without = self.fitted(quiet, np.where((pattern != int(np.argmax(dead))).all(1), change, np.nan))
            out |= {"dead_mm": 1e3 * max(dead), "dead_fit_mm": float(np.nanmean(without))}
        return out

    def model_of(self, pattern: np.ndarray, fidelity: je.Fidelity) -> je.Model:
        """The skin with another scan, for fits."""
        fidelity = je.Fidelity.draft() if self.smoke else fidelity
        return je.discretise(je.Scene(je.skin.with_rows(self.skin, pattern)), fidelity)

    def finder(self, model: je.Model, louder: float) -> je.contacts.ContactFinder:
        """What finds contacts in frames of this noise."""
        settings = je.contacts.ContactSettings(most=2, columns=21 if self.smoke else 41)
        return je.prepare_contacts(model, settings, noise=np.full(model.readings, louder * self.noise))

    def frames(self, change: np.ndarray, louder: float) -> Iterator[np.ndarray]:
        """Draws of the frames, (presses, readings) V each."""
        rng = np.random.default_rng(SEED + 1)
        for _ in range(DRAWS if louder else 1):
            yield change + louder * self.noise * rng.normal(size=change.shape)

    def fitted(self, fit: je.contacts.ContactFinder, change: np.ndarray, louder: float = 1.0) -> np.ndarray:
        """Errors of the places of fitted contacts, mm, NaN where none is found."""
        found = [je.contacts.strongest(fit(jnp.asarray(frames))) for frames in self.frames(change, louder)]
        return 1e3 * np.concatenate([je.localisation_error(places, self.sites) for places in found])

    def errors(self, fitted: np.ndarray, name: str) -> Row:
        figures = {"mm": np.nanmean, "median_mm": np.nanmedian, "p95_mm": lambda e: np.nanquantile(e, 0.95)}
        found: Row = {f"{name}_{figure}": float(of(fitted)) for figure, of in figures.items()}
        return found | {f"{name}_lost": float(np.mean(np.isnan(fitted)))}

    def at_once(self, way: str, pattern: np.ndarray, channels: int, certificate: float | None = None) -> Row:
        """Errors of the contacts fitted to a scan of several sense channels, and its rate."""
        protocol = je.Protocol(pattern, reading_time=self.skin.protocol.reading_time, sense_channels=channels)
        found = self.row(way, pattern)
        return found | {"channels": channels, "frames_per_s": 1 / protocol.frame_time, "certificate": certificate}

    def designed(self, way: str, count: int, **how: Any) -> Row:
        began = perf_counter()
        found = je.scan.design_scan(self.sensitivity, count, **how)
        seconds = perf_counter() - began
        return self.row(way, found.pattern, seconds) | {"certificate": found.bound / found.error}


def measure(run: Run) -> Iterator[Row]:
    """A row for each scan."""
    bench = Bench(run.smoke)
    yield {"presses": len(bench.sites), "rows": []}
    electrodes = len(bench.skin.electrodes)
    for name in run.sizes(("adjacent", "opposite", "skip-3"), ("adjacent",)):
        yield {"rows": [bench.row(name, je.skin.named_pattern(name, electrodes))]}
    for count in run.sizes(COUNTS, (40,)):
        pattern = bench.skin.protocol.pattern[np.sort(bench.order[:count])]
        greedy = [bench.row(GREEDY, pattern)] if count < len(bench.order) else []
        yield {"rows": [*greedy, bench.designed(DESIGNED, count)]}
    for count in run.sizes(DEAD, ()):
        yield {"rows": [bench.designed(CAREFUL, count, any_dead=True)]}
    for count in run.sizes((100,), ()):
        yield {"rows": [bench.designed("designed for the worst place", count, criterion=je.scan.PlaceError(8.0))]}
        yield {"rows": [bench.designed("designed, D-optimal", count, criterion=je.scan.PlaceVolume())]}


def without(run: Run) -> Iterator[Row]:
    """What is left when an electrode is dead from the start: the bound of the best scan without it."""
    bench = Bench(run.smoke)
    yield {"without": []}
    for count in run.sizes(DEAD, (40,)):
        whole = je.scan.design_scan(bench.sensitivity, count).error
        for electrode in (0, 12):
            kept = bench.every[(bench.every != electrode).all(1)]
            found = je.scan.design_scan(bench.sensitivity, count, candidates=kept)
            row: Row = {"electrode": electrode, "readings": count, "whole_mm": 1e3 * whole}
            row |= {"bound_mm": 1e3 * found.error, "loss": found.error / whole - 1}
            yield {"without": [row]}


def floor(run: Run) -> Iterator[Row]:
    """Where the errors of fits without noise come from, and what fits take in processor time."""
    bench = Bench(run.smoke)
    uneven = bench.pressed((je.effects.ContactGain(GAIN, GAIN_LENGTH, seed=SEED),))
    designed = je.scan.design_scan(bench.sensitivity, 40 if run.smoke else 100).pattern
    yield {"floor": []}
    for way, pattern in (("adjacent", bench.skin.protocol.pattern), (DESIGNED, designed)):
        for mesh in ("draft", "standard"):
            model = bench.model_of(pattern, getattr(je.Fidelity, mesh)())
            fit = bench.finder(model, 1.0)
            about = {"way": way, "readings": len(pattern), "mesh": mesh}
            yield {"floor": [about | {"fit": "bumps"} | _floor(bench, pattern, uneven, partial(_bumps, bench, fit))]}
        loads = je.contacts.prepare_loads(model, noise=np.full(len(pattern), bench.noise), sigma=model.background)
        found = _floor(bench, pattern, uneven, partial(_loads, bench, fit, loads))
        yield {"floor": [about | {"fit": "loads"} | found]}


Fitted = tuple[np.ndarray, float]  # errors, mm, and processor time of a frame, ms


def _floor(bench: Bench, pattern: np.ndarray, uneven: np.ndarray, fitted: Callable[[np.ndarray], Fitted]) -> Row:
    """Mean errors of fits without noise, with noise, and with noise on the uneven contact layer."""
    out: Row = {}
    for name, change, louder in (("exact", bench.change, 0.0), ("fit", bench.change, 1.0), ("uneven", uneven, 1.0)):
        errors, out["frame_ms"] = fitted(next(bench.frames(bench.seen(pattern, change), louder)))
        out[f"{name}_mm"] = float(np.nanmean(errors))
    return out


def _bumps(bench: Bench, fit: je.contacts.ContactFinder, frames: np.ndarray) -> Fitted:
    fit(jnp.asarray(frames))  # compiles
    began = process_time()
    places = np.asarray(je.contacts.strongest(fit(jnp.asarray(frames))))
    spent = 1e3 * (process_time() - began) / len(frames)
    return 1e3 * np.asarray(je.localisation_error(jnp.asarray(places), jnp.asarray(bench.sites))), spent


def _loads(bench: Bench, fit: je.contacts.ContactFinder, loads: je.contacts.LoadFitter, frames: np.ndarray) -> Fitted:
    found = fit(jnp.asarray(frames))
    chosen = range(0, len(frames), EVERY_OTHER)

    def place(k: int) -> np.ndarray:
        one = loads(frames[k], jax.tree.map(lambda leaf: leaf[k], found)).one
        return np.asarray(one.position[0])

    place(0)  # compiles
    began = process_time()
    places = np.stack([place(k) for k in chosen])
    spent = 1e3 * (process_time() - began) / len(chosen)
    return 1e3 * np.linalg.norm(places - bench.sites[::EVERY_OTHER], axis=1), spent


def channels(run: Run) -> Iterator[Row]:
    """Scans of hardware that takes several readings of a drive at once."""
    bench = Bench(run.smoke)
    adjacent = bench.skin.protocol.pattern
    yield {"channels": []}
    for count, times in run.sizes(((8, (75, 20)), (22, (25, 5))), ((22, (5,)),)):
        yield {"channels": [bench.at_once("adjacent", adjacent, count)]}
        for time in times:
            found = je.scan.design_scan(bench.sensitivity, time, sense_channels=count)
            yield {"channels": [bench.at_once(DESIGNED, found.pattern, count, found.bound / found.error)]}


def ladder(run: Run) -> Iterator[Row]:
    """What a quicker design loses: sites along x, seconds of a second call, and errors at sites that none has seen."""
    bench = Bench(run.smoke)
    unseen = je.scan.place_sensitivity(bench.model, je.scan.DesignSettings(noise=bench.noise, columns=UNSEEN))
    yield {"ladder": []}
    for columns in run.sizes(COLUMNS, COLUMNS[:1]):
        settings = je.scan.DesignSettings(noise=bench.noise, columns=columns)
        for _ in range(2):  # the first call compiles
            began = perf_counter()
            sensitivity = je.scan.place_sensitivity(bench.model, settings)
            found = je.scan.design_scan(sensitivity, 40 if run.smoke else 100)
            seconds = perf_counter() - began
        expected = 1e3 * np.asarray(unseen.errors(found.pattern))
        row = bench.row(f"{columns} along x", found.pattern, seconds) | {"sites": len(sensitivity.sites)}
        row |= {"bound_mm": float(expected.mean()), "bound_worst_mm": float(expected.max())}
        yield {"ladder": [row]}


main = Question(
    "design", __doc__, {"rows": measure, "without": without, "channels": channels, "ladder": ladder, "floor": floor}
)

if __name__ == "__main__":
    main()
