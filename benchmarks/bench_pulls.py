"""Whether stated standard errors are true: errors of predicted forces over them, of simulated calibrations.

Every curve that can be chosen is fitted without a field, and every field beside a straight line, to 200 simulations of
196 presses whose truth is of the same kind. An honest error has pulls of mean 0 and standard deviation 1. A field has
less, and a mean that is not 0 at a place, because its prior holds truths of all sizes, and the truth here is one.

The sampling errors are over fits, because the samples of one fit err together.
"""

from collections.abc import Callable, Iterator
from functools import partial

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.fitting.curves import CURVES, AbstractCurve, Linear
from calib.fitting.fields import FIELDS, AbstractField, geometry_of, single_places
from calib.fitting.losses import SoftL1
from calib.fitting.pads import LocatedPresses, PadModel, fit_pads, predict
from calib.presses.pooled import PressData

from .harness import Question, Run
from .rows import Row

TRIALS, PRESSES, STEPS = 200, 196, 24
SCATTER, NOISE = 0.03, 0.02  # of a press, of its force; of a reading, N
RISE = np.linspace(0.05, 1, STEPS // 2)
RAMP = np.concatenate([RISE, RISE[::-1]])


def owner(place: np.ndarray) -> np.ndarray:
    """Number (n,) of the pad below each place (n, 2) m."""
    return (place[:, 0] > 0.1) + 2 * (place[:, 1] > 0.1)


def presses_at(
    place: np.ndarray,
    peak: np.ndarray,
    rng: np.random.Generator,
    force_of: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> PressData:
    """Ramps to pressures `peak` (n,) Pa and back at places (n, 2) m; `force_of` pressures and places is their force."""
    count, own = len(place), np.eye(4)[owner(place)]
    pressure = (own[:, None] * (peak[:, None] * RAMP)[..., None]).reshape(-1, 4)
    press = np.repeat(np.arange(count), STEPS)
    force = force_of(pressure, place[press]) * np.exp(rng.normal(0, SCATTER, count))[press]
    force = force + rng.normal(0, NOISE, len(force))
    top = np.arange(count) * STEPS + STEPS // 2
    return PressData(
        sample_pressure=pressure.T.copy(),
        sample_force=force,
        sample_press=press,
        mask=own[press].T > 0,
        pressure=pressure[top],
        force=force[top],
        place=np.arange(count),
        reach=np.array([[0.01, 0.01], [0.19, 0.19]]),
    )


def forces(model: PadModel, pressure: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Total force (n,) N by a model, at pressures (n, 4) Pa and places (n, 2) m."""
    return np.asarray(predict(model, jnp.asarray(pressure), single_places(place, 4)).force).sum(1)


def places(rng: np.random.Generator) -> np.ndarray:
    """Places of the presses of a calibration, (n, 2) m."""
    return rng.uniform(0.012, 0.188, (PRESSES, 2))


def truth(skin: je.Skin, curve: AbstractCurve, field: AbstractField | None) -> PadModel:
    """The response that a fit finds to a law that stiffens, on pads whose gain dips by 30 % towards their edges."""
    rng = np.random.default_rng(0)
    place = places(rng)

    def law(pressure: np.ndarray, place: np.ndarray) -> np.ndarray:
        total = pressure.sum(1)
        dip = np.exp(-np.min([place % 0.1, 0.1 - place % 0.1], axis=(0, 2)) / 0.01) if field is not None else 0.0
        return 0.01 * total * (1 + 0.2 * total / 2000) * (1 - 0.3 * dip)

    data = presses_at(place, rng.uniform(1500, 2000, PRESSES), rng, law)
    return fit_pads(curve, field, LocatedPresses(data, geometry_of(skin), single_places(place, 4)), SoftL1())


def fits(
    skin: je.Skin, true: PadModel, curve: AbstractCurve, field: AbstractField | None, trials: int = TRIALS
) -> Iterator[PadModel]:
    """Fits to simulations of the true model."""
    for trial in range(trials):
        rng = np.random.default_rng([2, trial])
        place = places(rng)
        data = presses_at(place, rng.uniform(1500, 2000, PRESSES), rng, partial(forces, true))
        known = LocatedPresses(data, geometry_of(skin), single_places(place, 4))
        model = fit_pads(curve, field, known, SoftL1())
        assert (np.asarray(model.curves.result) == 0).all()
        yield model


def pulls(skin: je.Skin, curve: AbstractCurve, field: AbstractField | None, trials: int = TRIALS) -> np.ndarray:
    """Errors over stated errors of fits to simulations, (trials, samples), at loads of all pads."""
    true = truth(skin, curve, field)
    where = np.array([[0.03, 0.06], [0.17, 0.02], [0.05, 0.13], [0.13, 0.19]])
    rng = np.random.default_rng(1)
    new = presses_at(where, np.full(4, 1700.0), rng, partial(forces, true))
    at = single_places(where[new.sample_press], 4)
    own = new.mask.T & (new.sample_pressure.T > 0.1 * 1700)  # below, the force falls to that of a pad at rest
    pressure = jnp.asarray(new.sample_pressure.T)
    expected = np.asarray(predict(true, pressure, at).force)[own]
    found = []
    for model in fits(skin, true, curve, field, trials):
        seen = predict(model, pressure, at)
        found.append((np.asarray(seen.force)[own] - expected) / np.asarray(seen.standard_error)[own])
    return np.array(found)


def pulls_across_walls(skin: je.Skin, field: AbstractField, trials: int = TRIALS) -> np.ndarray:
    """Errors over stated errors of the total of presses that two pads share, (trials, presses)."""
    true, at = truth(skin, Linear(), field), np.array([[0.1, 0.05], [0.1, 0.15], [0.05, 0.1], [0.17, 0.1]])
    parts = np.array([[0.5, 0.5, 0, 0], [0, 0, 0.7, 0.3], [0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5]])
    pressure, where = jnp.asarray(1700 * parts), single_places(at, 4)
    expected, found = forces(true, pressure, at), []
    for model in fits(skin, true, Linear(), field, trials):
        seen = predict(model, pressure, where)
        found.append((np.asarray(seen.force).sum(1) - expected) / np.sqrt(seen.total_variance))
    return np.array(found)


SHARED = ("edge", "edge-spline", "bilinear")  # fields that pads share, across whose walls errors add up


def measure(run: Run) -> Iterator[Row]:
    """A row for each curve, each field, and each field of which presses across walls are predicted."""
    skin = je.load_skin("testbed")
    trials = 3 if run.smoke else TRIALS
    for name in run.sizes(list(CURVES.shipped), ["linear"]):
        yield {"rows": [judged(f"curve {name}", pulls(skin, CURVES.make(name), None, trials))]}
    for name in run.sizes(list(FIELDS.shipped), []):
        yield {"rows": [judged(f"field {name}", pulls(skin, Linear(), FIELDS.make(name), trials))]}
    for name in run.sizes(SHARED, []):
        yield {"rows": [judged(f"field {name}, across walls", pulls_across_walls(skin, FIELDS.make(name), trials))]}


def judged(what: str, found: np.ndarray) -> Row:
    """Mean and deviation of pulls (fits, samples), with their errors over fits, and the mean at the worst sample."""
    root, mean, deviation = np.sqrt(len(found)), float(found.mean()), float(found.std())
    square = np.mean((found - mean) ** 2, 1)
    worst = np.abs(found.mean(0)).max()
    numbers = {
        "mean": mean,
        "mean_error": found.mean(1).std(ddof=1) / root,
        "deviation": deviation,
        "deviation_error": square.std(ddof=1) / root / (2 * deviation),
        "worst_mean": worst,
    }
    return {"what": what, "fits": len(found)} | {name: round(float(value), 4) for name, value in numbers.items()}


main = Question("pulls", __doc__, {"rows": measure})

if __name__ == "__main__":
    main()
