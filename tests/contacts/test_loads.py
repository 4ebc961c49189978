"""Loads fitted through the pressure law: what they are, how many, where, and how sure."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from benchmarks.problems import pressed
from calib.calibration.localisation.load_windows import FIDELITY
from jaxeit.contacts import LoadKind, LoadSettings, prepare_loads
from jaxeit.imaging import InverseError

TIPS = 9  # that an edge is simulated by
GAIN = je.effects.ContactGain(0.12, 0.015, seed=71)
COAT = je.effects.CoatingNonUniformity(0.15, 0.03, seed=70)


def frames_of(touches, effects=(COAT, GAIN), seed=0):
    """Frames (n, readings), noise and untouched frame of touches: lists of places and forces, on another mesh."""
    places = np.array([np.concatenate([p, np.repeat(p[-1:], TIPS - len(p), 0)]) for p, _ in touches])
    loads = np.array([np.concatenate([f, np.zeros(TIPS - len(f))]) for _, f in touches])
    found = pressed(effects, places, loads)
    blank, frames = found.frames(np.random.default_rng(seed))
    return frames, np.full(blank.size, found.noise), blank


def single(x, y, force=20.0):
    return np.array([[x, y]]), np.array([force])


def pair(x, y, distance, angle, share=1.0, force=20.0):
    step = distance / 2 * np.array([np.cos(angle), np.sin(angle)])
    return np.array([x, y]) + np.array([-step, step]), force * np.array([1.0, share])


def edge(x, y, length, angle, force=20.0):
    step = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    return [x, y] + np.linspace(-1, 1, TIPS)[:, None] * step, np.full(TIPS, force / TIPS)


TOUCHES = {
    "one": (LoadKind.ONE, single(0.09, 0.12)),
    "one in a corner": (LoadKind.ONE, single(0.025, 0.03)),
    "two at 30 mm": (LoadKind.TWO, pair(0.1, 0.08, 0.03, 0.7)),
    "two at 40 mm, one of a third": (LoadKind.TWO, pair(0.08, 0.1, 0.04, 2.0, 1 / 3)),
    "an edge of 30 mm": (LoadKind.EDGE, edge(0.1, 0.1, 0.03, 1.2)),
    "an edge of 60 mm": (LoadKind.EDGE, edge(0.11, 0.09, 0.06, 0.3)),
}


@pytest.fixture(scope="module")
def ready():
    """The fitter, the finder, and the frames of `TOUCHES`."""
    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
    frames, noise, blank = frames_of([touch for _, touch in TOUCHES.values()])
    finder = je.prepare_contacts(model, noise=noise, untouched=blank)
    return prepare_loads(model, noise=noise, untouched=blank), finder, frames, noise


def seen(ready, number):
    fitter, finder, frames, _ = ready
    return fitter(frames[number], finder(frames[number]))


@pytest.mark.parametrize("number", range(len(TOUCHES)), ids=TOUCHES)
def test_what_touches_the_sheet_is_told(ready, number):
    """On a mesh, a coat and a gain of the contact layer that the fit does not know."""
    kind, (places, forces) = list(TOUCHES.values())[number]
    found = seen(ready, number)
    assert found.kind is kind
    assert found.probability[kind] > 0.7
    assert found.probability.sum() == pytest.approx(1)
    best = found.best
    assert best.misfit < 1.4
    if kind is LoadKind.EDGE:
        ends = np.asarray(best.position + np.array([-1, 1])[:, None] * best.half)
        places, forces = places[[0, -1]], forces.sum()[None]
    else:
        ends = np.asarray(best.position)
    away = min(np.linalg.norm(ends - places, axis=1).max(), np.linalg.norm(ends[::-1] - places, axis=1).max())
    assert away < (0.008 if kind is LoadKind.EDGE else 0.004)
    np.testing.assert_allclose(np.sort(best.force), np.sort(forces), rtol=0.35)


def test_a_blank_frame_holds_nothing(ready):
    fitter, finder, frames, noise = ready
    blank = noise * np.random.default_rng(5).normal(size=frames.shape[1])
    found = fitter(blank, finder(blank))
    assert found.kind is LoadKind.NONE
    assert found.best is None
    assert found.probability[0] == 1


def test_pressure_of_loads_sums_to_their_force(ready):
    fitter = ready[0]
    areas = np.asarray(fitter.model.areas)
    total = lambda p: float(np.sum(areas * (np.asarray(p) @ np.asarray(fitter.weights))))  # noqa: E731
    spot = jnp.array([0.1, 0.1, np.log(0.01), np.log(7.0)])
    assert total(fitter._spot(spot)) == pytest.approx(7.0, rel=2e-3)
    for half in ((0.02, 0.01), (0.0, 0.0)):
        assert total(fitter._line(jnp.append(spot, jnp.array(half)))) == pytest.approx(7.0, rel=5e-3)
    np.testing.assert_allclose(
        fitter._line(jnp.append(spot, jnp.array([1e-6, 0.0]))), fitter._spot(spot), rtol=1e-4, atol=1.0
    )


def test_the_gain_of_the_contact_layer_has_its_size_and_length(ready):
    modes = np.asarray(ready[0].modes)
    middle = np.asarray(ready[0].points)[:, 0]
    inner = np.flatnonzero((np.abs(middle - 0.1) < 0.05).all(1))[:60]
    covariance = modes[inner, 0] @ modes[inner, 0].T
    distance = np.linalg.norm(middle[inner, None] - middle[inner], axis=-1)
    np.testing.assert_allclose(covariance, 0.12**2 * np.exp(-(distance**2) / (2 * 0.015**2)), atol=0.1 * 0.12**2)


def test_covariances_grow_with_the_gain_that_is_not_known(ready):
    found = seen(ready, 0).one
    error = np.sqrt(np.diag(np.asarray(found.covariance)))[:2]
    assert (error > 2e-4).all()
    assert (error < 2e-3).all()


def test_what_cannot_be_fitted_is_refused(ready):
    fitter, finder, frames, noise = ready
    contacts = finder(frames[0])
    with pytest.raises(InverseError, match="fit one frame of 550 readings at a time"):
        fitter(frames[:2], contacts)
    with pytest.raises(InverseError, match="both tell the sheet"):
        prepare_loads(fitter.model, noise=noise, untouched=np.ones(550), sigma=fitter.sigma)
    with pytest.raises(InverseError, match="give the 550 readings of one frame"):
        je.prepare_contacts(fitter.model, noise=noise, untouched=np.ones(5))
    with pytest.raises(InverseError, match="reading 3 is not finite"):
        fitter(np.where(np.arange(550) == 3, np.nan, frames[0]), contacts)
    for bad in ({"width": 0.0}, {"gain": -1.0}, {"prior": (1.0, 0.0, 0.0)}, {"prior": (0.5, 0.5, 0.5, 0.5)}):
        with pytest.raises(InverseError, match=next(iter(bad))):
            LoadSettings(**bad)


@pytest.mark.slow
def test_ellipses_hold_nine_of_ten_places():
    """Single touches anywhere, three sheets known from v0, on a mesh whose own error is small beside the gain's."""
    model = je.discretise(je.Scene(je.load_skin("testbed")), FIDELITY)
    inside = []
    for seed in range(3):
        rng = np.random.default_rng(100 + seed)
        effects = (
            je.effects.CoatingNonUniformity(0.15, 0.03, seed=2 * seed + 500),
            je.effects.ContactGain(0.12, 0.015, seed=2 * seed + 501),
        )
        places = rng.uniform(0.02, 0.18, (25, 2))
        frames, noise, blank = frames_of([single(*place) for place in places], effects, seed)
        finder = je.prepare_contacts(model, noise=noise, untouched=blank)
        fitter = prepare_loads(model, noise=noise, untouched=blank)
        for place, frame in zip(places, frames, strict=True):
            one = fitter(frame, finder(frame)).one
            away = np.asarray(one.position[0]) - place
            inside.append(away @ np.linalg.solve(np.asarray(one.covariance)[:2, :2], away) < 4.605)
    assert 0.82 < np.mean(inside) < 0.98
