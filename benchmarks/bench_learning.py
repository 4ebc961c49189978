"""What presses teach of the contact layer: errors of place and force after 0 to 480 presses, and ranks of the truth.

Flat round tips of 5 to 30 mm, which the tracker does not know, press with 4 to 25 N at random places of a testbed skin
whose coat and contact layer are drawn anew for each seed, on another mesh than that of the tracker. A press is one
frame, with noise 60 dB below the readings; the pads tell their forces to 3 % and 0.1 N; the untouched sheet is fitted
to the mean of 100 frames, and the depth of the sheet and the model error to the first 24 presses, as `live` does.
Presses teach one after the other, as `learn_layer` has them teach: `Tracker.press`, `Tracker.learned`, and the law of
contacts. After each stage the layer is frozen and asked about other presses, the same frames at each stage, so that
errors are paired. At 0 presses nothing is taught.

Loads: Gaussian, as wide as the tip with a pad that spreads by 8 mm; or of the tip on an elastic half-space, 10 mm deep,
about as wide with other tails. Pressure changes the sheet by the law that the tracker takes for granted.

place: mean error, the pads telling forces. no pad: place and force by the readings alone, as where all pads leak; the
force with the gain alone, and with the law as well. Errors of force are relative to what the sheet bears. worse: skins
on which the mean error is above that of the same presses with nothing taught. "gain known": the layer is given as it
is; "and no noise": frames without noise, too, and exact pads. Learning cannot improve what is left then.

Ranks: simulation-based calibration (Talts et al. 2018, arXiv:1804.06788). Among 99 draws from what is told of a press,
the rank of the true place, along both axes of its covariance, and of the true force; in ten equal bins, with the
chi-squared test of even ones. "belief": the filter's own, whose loads are Gaussian; "stated": with the errors by
unknown shapes, as tracks have them. Presses of a skin share a layer, so that their ranks are not quite independent and
the test is a little too strict.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chisquare

import jaxeit as je
from calib.calibration.localisation.learned.law_lessons import updated_law
from jaxeit.tracking import ContactLaw, LearnedLayer, Tracker, Tracking, fit_model_error, prepare_tracker
from jaxeit.tracking.belief import PRESS_VARIANCES

from .bench_contact_law import as_presses_tell, gaussian
from .harness import Question, Run, with_one_blas_thread
from .problems import Pressed, fit_model, uneven
from .rows import Row, grouped, rounded

FIRST_SEED = 9400
SEEDS, TESTS = 6, 30
STAGES = (0, 10, 30, 120, 480)
PROBES = 24  # first presses, which tell the model error
DIAMETERS, FORCES = (0.005, 0.03), (4.0, 25.0)  # m, N
PAD_SPREAD, DEPTH = 0.008, 0.01  # m
PAD_ERROR = (0.03, 0.1)  # relative, and N
EDGE_LENGTH = 0.026  # m, of the mesh of the skin
GAUSSIAN, HALF_SPACE = "Gaussian", "half-space"
DRAWS, BINS = 99, 10
RANKED = (0, 30, 480)  # presses after which ranks are counted
KNOWN, NOISELESS = "gain known", "and no noise"
LOST_MM = 100.0  # error of a place of which nothing is told
GRID = np.stack(np.meshgrid(*2 * [np.linspace(0.0, 0.2, 41)]), -1).reshape(-1, 2)  # m, where the true gain is read
GAIN_PRECISION = 0.01  # to which a gain that is known is put into modes


class Presses(NamedTuple):
    """Places (n, 2) m, forces on the sheet (n,) N, forces on pads (n, pads) N, and readings of presses."""

    places: np.ndarray
    forces: np.ndarray
    pads: np.ndarray
    found: Pressed


class Skin:
    """A skin of one seed, on its mesh."""

    def __init__(self, seed: int):
        self.skin, self.rng = je.load_skin("testbed"), np.random.default_rng([seed, 31])
        self.coat, self.gain = uneven(seed)
        effects = (je.effects.IndentationSpreading(DEPTH), self.coat, self.gain, je.effects.ContactPiezoresistance())
        self.model = je.discretise(je.Scene(self.skin, effects), je.Fidelity.standard(edge_length=EDGE_LENGTH))
        self.untouched = np.asarray(je.forward(self.model))

    def pressed(self, shape: str, count: int) -> Presses:
        """Presses of tips anywhere on the skin."""
        places, diameters = self.rng.uniform(0.02, 0.18, (count, 2)), self.rng.uniform(*DIAMETERS, count)
        pressure = self.rng.uniform(*FORCES, count)[:, None] * SHAPES[shape](self.model, places, diameters)
        change = np.asarray(_readings(self.model, jnp.asarray(pressure))) - self.untouched
        pixels = je.Pixels(20).on(self.model)
        loads = np.array([pixels.restrict(one * self.model.areas) for one in pressure])
        pads = loads @ np.asarray(je.pad_masks(self.skin, pixels).weights).T
        return Presses(places, loads.sum(1), pads, Pressed.of(self.untouched, change))

    def known(self, tracker: Tracker) -> LearnedLayer:
        """The gain as it is, in the modes of a tracker."""
        modes, true = tracker.field.modes_at(GRID), self.true_gain
        covariance = np.linalg.inv(modes.T @ modes / GAIN_PRECISION**2 + np.eye(modes.shape[1]))
        layer = LearnedLayer.normal(
            tracker.field, covariance @ modes.T @ true / GAIN_PRECISION**2, covariance, contacts=0
        )
        return replace(layer, evidence=np.where(PRESS_VARIANCES == 0, 0.0, -1e3))  # presses have no effect of their own

    @property
    def true_gain(self) -> np.ndarray:
        """The true log gain at the places of `GRID`."""
        return np.asarray(self.gain.std * self.gain.laid(jnp.asarray(GRID)).field)


def _gaussians(model: je.Model, places: np.ndarray, diameters: np.ndarray) -> np.ndarray:
    width = np.hypot(PAD_SPREAD, diameters / 4)  # an even disc has a quarter of its diameter
    return np.array([gaussian(model, *one) for one in zip(places, width, strict=True)])


def _half_space(model: je.Model, places: np.ndarray, diameters: np.ndarray) -> np.ndarray:
    given = zip(places, diameters, strict=True)
    return np.array([je.model.load_spread(model, place, diameter) for place, diameter in given])


SHAPES = {GAUSSIAN: _gaussians, HALF_SPACE: _half_space}  # pressure of one newton on the elements, Pa
TAKEN = "half-space taken for Gaussian"
# Shape of the loads, and whether presses tell how loads spread.
CASES = {GAUSSIAN: (GAUSSIAN, True), HALF_SPACE: (HALF_SPACE, True), TAKEN: (HALF_SPACE, False)}


@eqx.filter_jit
def _readings(model: je.Model, pressure: jax.Array) -> jax.Array:
    return jax.lax.map(lambda one: je.forward(model, je.conductivity(model, one)), pressure)


class Shown(NamedTuple):
    """A frame (readings,) V, forces on the pads and their standard errors (pads,) N."""

    frame: np.ndarray
    forces: np.ndarray
    errors: np.ndarray


class Session:
    """A tracker of a skin, and what it is shown of presses.

    Args:
        probes: first presses, which tell how loads spread and how far the model errs; 0: the tracker stays as it is.
        spread: whether presses tell how loads spread; otherwise they are taken for Gaussian.
    """

    def __init__(
        self, model: je.Model, skin: Skin, presses: Presses, seed: int, probes: int = PROBES, spread: bool = True
    ):
        self.rng, self.std = np.random.default_rng([seed, 37]), presses.found.std
        untouched = presses.found.blank(self.rng)
        self.prepare = partial(prepare_tracker, model, skin.skin, noise=self.std, untouched=untouched)
        shown = [self.shown(presses, number) for number in range(probes)]
        told = [np.array(part) for part in zip(*shown, strict=True)]
        if spread and probes:
            self.tracker = as_presses_tell(self.prepare, *told)
        else:
            self.tracker = fit_model_error(self.prepare(), *told) if probes else self.prepare()

    def shown(self, presses: Presses, number: int, noise: float = 1.0) -> Shown:
        """A press with so much of the usual noise."""
        change, exact = presses.found.change[number], presses.pads[number]
        errors = np.hypot(PAD_ERROR[0] * exact, PAD_ERROR[1])
        frame = change + noise * self.std * self.rng.normal(size=change.size)
        return Shown(frame, exact + noise * errors * self.rng.normal(size=errors.size), errors)

    def taught(self, presses: Presses, stages: Sequence[int]) -> Iterator[tuple[int, LearnedLayer, ContactLaw]]:
        """Layer and law after each stage."""
        layer, law = LearnedLayer.unknown(self.tracker.field), ContactLaw.unknown()
        for number in range(max(stages) + 1):
            if number in stages:
                yield number, layer, law
            if number < max(stages):
                shown = self.shown(presses, number)
                now = self.tracker.press(*shown, layer=layer)
                if self.tracker.told_by_pads(now.tracks, shown.errors).any():
                    law = updated_law(law, self.tracker, now.tracks[0], shown.frame, layer)
                layer = self.tracker.learned(now)

    def judged(
        self, presses: Presses, number: int, shown: Shown, layer: LearnedLayer, law: ContactLaw | None = None
    ) -> Row:
        """Errors of a press under a frozen layer, with the pads and without, and pulls of the truth."""
        law = ContactLaw.unknown() if law is None else law
        place, force = presses.places[number], presses.forces[number]
        told, alone = self.tracker.press(*shown, layer=layer), self.tracker.press(shown.frame, layer=layer)
        found: Row = {"mm": LOST_MM, "alone mm": LOST_MM, "force": 1.0, "law force": 1.0}
        if told.tracks:
            found |= {"mm": 1e3 * float(np.linalg.norm(told.tracks[0].position - place))}
            found |= {f"{way} place": pulls for way, pulls in _pulls(told, slice(0, 2), place)}
        if alone.tracks:
            (track,) = alone.tracks
            found |= {
                "alone mm": 1e3 * float(np.linalg.norm(track.position - place)),
                "force": abs(track.force / force - 1),
                "law force": abs(law.applied(track).force / force - 1),
            }
            found |= {f"{way} force": pulls for way, pulls in _pulls(alone, slice(3, 4), np.log([force]))}
        return found


def _pulls(now: Tracking, part: slice, true: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Pulls of the true numbers along the axes of their covariance: of the filter alone, and as stated of the track."""
    away = true - np.asarray(now.belief.contacts)[0, part]
    own = np.asarray(now.belief.covariance)[part, part]
    track = now.tracks[0]
    stated = track.covariance if part.start == 0 else np.array([[track.log_force_error**2]])
    for way, covariance in (("belief", own), ("stated", stated)):
        values, axes = np.linalg.eigh(covariance)
        yield way, axes.T @ away / np.sqrt(values)


def ranks(rng: np.random.Generator, pulls: np.ndarray) -> np.ndarray:
    """Rank of each truth among `DRAWS` draws of a normal distribution, from 0 to `DRAWS`."""
    return (rng.normal(size=(len(pulls), DRAWS)) < pulls[:, None]).sum(1)


def ranked(rows: Sequence[Row], way: str, what: str) -> Row:
    """Share of ranks in each of `BINS` bins, and the probability of counts that are less even by chance."""
    pulls = np.concatenate([row[f"{way} {what}"] for row in rows if f"{way} {what}" in row])
    found = ranks(np.random.default_rng([FIRST_SEED, len(pulls)]), pulls)
    counts = np.bincount(found * BINS // (DRAWS + 1), minlength=BINS)
    shares = " ".join(f"{100 * count / len(found):.0f}" for count in counts)
    return {f"{what} ranks": len(found), f"{what} shares": shares, f"{what} p": float(chisquare(counts).pvalue)}


def one_shape(run: Run, case: str) -> Iterator[Row]:
    """Errors and ranks on skins that tips press in one way."""
    shape, spread = CASES[case]
    seeds, stages, count, probes = run.sizes((SEEDS, STAGES, TESTS, PROBES), (1, (0, 2), 2, 2))
    model, rows = fit_model(), []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        skin = Skin(seed)
        teaching, given = skin.pressed(shape, max(stages)), skin.pressed(shape, count)
        session = Session(model, skin, teaching, seed, probes, spread)
        shown = [session.shown(given, number) for number in range(count)]
        exact = [session.shown(given, number, noise=0.0) for number in range(count)]

        def asked(presses: Any, frames: list[Shown], *known: Any, at: Any = (session, given, seed)) -> list[Row]:
            told, tests, own = at
            about = {"presses": presses, "seed": own, "depth": told.tracker.field.depth}
            return [about | told.judged(tests, number, one, *known) for number, one in enumerate(frames)]

        for number, layer, law in session.taught(teaching, stages):
            rows += [row | {"law": law.is_better} for row in asked(number, shown, layer, law)]
        for name, frames in ((KNOWN, shown), (NOISELESS, exact)):
            rows += [row | {"law": False} for row in asked(name, frames, skin.known(session.tracker))]
        own = progress([row for row in rows if row["seed"] == seed])
        print(f"{case}, skin {seed}, depth {1e3 * session.tracker.field.depth:.1f} mm: {own}", flush=True)
    after = grouped(rows, "presses")
    yield {case: [{"load": case} | summary(presses, some, after[0]) for presses, some in after.items()]}
    yield {
        f"{case} ranks": [
            {"load": case, "way": way, "presses": presses} | ranked(some, way, "place") | ranked(some, way, "force")
            for way in ("belief", "stated")
            for presses, some in after.items()
            if presses in (RANKED if not run.smoke else stages)
        ]
    }


def progress(rows: Sequence[Row]) -> str:
    """Mean error of place after each stage, in one line."""
    means = (f"{n}: {np.mean([row['mm'] for row in some]):.2f}" for n, some in grouped(rows, "presses").items())
    return f"place, mm: {', '.join(means)}"


def summary(presses: Any, rows: Sequence[Row], before: Sequence[Row]) -> Row:
    """Errors after so many presses, and on how many skins they are above those of the same presses before any."""
    names = {"mm": np.mean, "alone mm": np.mean, "force": np.median, "law force": np.median}
    found: Row = {"presses": presses, "tests": len(rows), "skins": len(grouped(rows, "seed"))}
    found |= rounded({name: mean([row[name] for row in rows]) for name, mean in names.items()})
    found |= rounded({f"{name} 90": np.quantile([row[name] for row in rows], 0.9) for name in names})
    for name in names:
        means, first = (
            {seed: np.mean([row[name] for row in some]) for seed, some in grouped(every, "seed").items()}
            for every in (rows, before)
        )
        found[f"{name} worse"] = sum(bool(means[seed] > first[seed]) for seed in means)
        found[f"{name} worst"] = round(max(float(means[seed] / first[seed]) for seed in means), 3)
        found[f"{name} ratios"] = [round(float(means[seed] / first[seed]), 3) for seed in means]
    depths = [1e3 * some[0]["depth"] for some in grouped(rows, "seed").values()]
    found |= {"depth low": round(min(depths), 1), "depth high": round(max(depths), 1)}
    return found | {"law used": len({row["seed"] for row in rows if row["law"]})}


main = Question("learning", __doc__, {case.lower(): partial(one_shape, case=case) for case in CASES})

if __name__ == "__main__":
    with_one_blas_thread()  # small matrices: threads that wait for one another cost ten times as much
    main()
