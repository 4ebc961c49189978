"""Scans designed over all four-terminal readings, verified by fits of contacts.

Single presses of 8 N by a 20 mm tip at places all over the testbed, simulated on another mesh than the one on which
scans are designed and contacts found; every reading of all scans has the same noise, 60 dB (and once more 50 dB) below
the rms of the shipped scan's readings; three draws of it. "Bound": the mean error that `place_sensitivity` expects at
the sites of the design, over the whole sheet, for contacts of 25 %, a width of 12 mm and a model error of 1.5 %; the
presses are 15 mm or more from the rim. "Dead": readings of one electrode are left out, of the one that costs most.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

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
        with TemporaryDirectory() as folder:
            path = Path(folder) / "every.toml"
            path.write_text(je.skin.with_rows(self.skin, self.every).toml, encoding="utf-8")
            loads = np.full((presses, 1), LOAD)
            self.change = pressed((), self.sites[:, None], loads, 0.06 if smoke else 0.026, skin=str(path)).change
        self.model = je.discretise(je.Scene(self.skin), je.Fidelity.draft())
        self.noise = 1e-3 * float(jnp.sqrt(jnp.mean(je.forward(self.model) ** 2)))
        settings = je.scan.DesignSettings(noise=self.noise, columns=4 if smoke else 8)
        self.sensitivity = je.scan.place_sensitivity(self.model, settings)
        signal = je.scan.signal_covariance(self.model, basis=je.Pixels(20).on(self.model))
        self.order = np.asarray(je.scan.choose_readings(signal, len(signal)).rows)
        self.place = {tuple(row): index for index, row in enumerate(self.every.tolist())}

    def seen(self, pattern: np.ndarray) -> np.ndarray:
        """What a scan reads of the presses, less the untouched skin, without noise, (presses, readings) V."""
        pairs = np.sort(pattern.reshape(-1, 2, 2), 2)
        swap = (pairs[:, 0, 0] > pairs[:, 1, 0])[:, None, None]
        rows = np.where(swap, pairs[:, ::-1], pairs).reshape(-1, 4)
        sign = np.where((pattern[:, 0] > pattern[:, 1]) ^ (pattern[:, 2] > pattern[:, 3]), -1, 1)
        return np.asarray(sign * self.change[:, [self.place[tuple(row)] for row in rows.tolist()]])

    def row(self, way: str, pattern: np.ndarray, seconds: float | None = None) -> Row:
        """Errors of the contacts fitted to a scan, beside the bound."""
        model = je.discretise(je.Scene(je.skin.with_rows(self.skin, pattern)), je.Fidelity.draft())
        bound = 1e3 * np.asarray(self.sensitivity.errors(pattern))
        out: Row = {"way": way, "readings": len(pattern), "drives": len(np.unique(np.sort(pattern[:, :2], 1), axis=0))}
        out |= {"frames_per_s": 1 / (len(pattern) * self.skin.protocol.reading_time), "design_s": seconds}
        out |= {
            "bound_mm": float(bound.mean()),
            "bound_worst_mm": float(bound.max()),
            "dead_mm": None,
            "dead_fit_mm": None,
        }
        fitted = self.fitted(model, pattern, 1.0)
        out |= self.errors(fitted, "fit") | self.errors(self.fitted(model, pattern, LOUD), "loud")
        if len(pattern) in DEAD or self.smoke:
            dead = [float(jnp.mean(self.sensitivity.errors(pattern, e))) for e in range(len(self.skin.electrodes))]
            without = self.fitted(model, pattern, 1.0, (pattern != int(np.argmax(dead))).all(1))
            out |= {"dead_mm": 1e3 * max(dead), "dead_fit_mm": float(np.nanmean(without))}
        return out

    def fitted(self, model: je.Model, pattern: np.ndarray, louder: float, used: np.ndarray | bool = True) -> np.ndarray:
        """Errors of the places of fitted contacts, mm, NaN where none is found."""
        noise = louder * self.noise
        settings = je.contacts.ContactSettings(most=2, columns=21 if self.smoke else 41)
        fit = je.prepare_contacts(model, settings, noise=np.full(len(pattern), noise))
        change = self.seen(pattern)
        rng = np.random.default_rng(SEED + 1)
        errors = []
        for _ in range(DRAWS):
            frames = np.where(used, change + noise * rng.normal(size=change.shape), np.nan)
            errors.append(je.localisation_error(je.contacts.strongest(fit(jnp.asarray(frames))), self.sites))
        return 1e3 * np.concatenate(errors)

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
        for electrode in (0, 12):
            kept = bench.every[(bench.every != electrode).all(1)]
            found = je.scan.design_scan(bench.sensitivity, count, candidates=kept)
            yield {"without": [{"electrode": electrode, "readings": count, "bound_mm": 1e3 * found.error}]}


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


main = Question("design", __doc__, {"rows": measure, "without": without, "channels": channels, "ladder": ladder})

if __name__ == "__main__":
    main()
