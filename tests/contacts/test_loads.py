"""Loads fitted through the pressure law: what they are, how many, where, and how sure."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from calib.calibration.localisation.load_windows import LOAD_FIDELITY
from jaxeit.contacts import AbstractGain, LoadKind, LoadSettings, prepare_loads
from jaxeit.contacts.loads.fits.comparison import evidences, log_evidence
from jaxeit.contacts.loads.fits.kinds import Fit, FrameFits
from jaxeit.contacts.loads.pressure import (
    LOAD_PARAMETERS,
    MAX_LOADS,
    LoadForm,
    elongations,
    line,
    pad_rows,
    pressure,
    shape_directions,
    spot,
)
from jaxeit.contacts.loads.spreading import Spreading
from jaxeit.imaging import InverseError
from jaxeit.model.forward_model import transfer
from jaxeit.model.gaussian_field import field_modes
from jaxeit.model.sheet_conductivity import coefficients
from tests.compiled import compiled

from .touches import GAIN, TOUCHES, frames_of, pair, ring, single, tilted


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
        there, places, forces = np.asarray(best.ends), places[[0, -1]], forces.sum()[None]
    else:
        there = np.asarray(best.position)
    away = np.linalg.norm(there[:, None] - places, axis=2)
    assert away.min(0).max() < (0.008 if kind is LoadKind.EDGE else 0.004)
    np.testing.assert_allclose(np.sort(best.force), np.sort(forces), rtol=0.35)


def test_settings_say_what_differs_from_the_usual_ones():
    assert LoadSettings().changed() == ""
    assert LoadSettings(force=5.0, law=je.effects.ContactPiezoresistance(half_pressure=1e4)).changed().count(" = ") == 2
    assert LoadSettings.round_tips(force=5.0).changed() == (
        "shape = 0.03, shapes = (0.0, 1.0), force = 5.0, nearest = 0.008, prior = (0.25, 0.25, 0.25, 0.0, 0.25)"
    )


@pytest.mark.slow
def test_near_tips_are_told_apart_where_only_round_ones_touch(ready):
    """A flat or a long tip would explain them; one tip stays one."""
    fitter, finder, _, _ = ready
    frames, noise, blank = frames_of([pair(0.1, 0.08, 0.02, 0.7), single(0.06, 0.13)], seed=4)
    usual = fitter(frames[0], finder(frames[0]))
    assert usual.kind is not LoadKind.TWO
    model = je.discretise(je.Scene(je.load_skin("testbed")), LOAD_FIDELITY)
    of_round = prepare_loads(model, LoadSettings.round_tips(), noise=noise, untouched=blank)
    two, one = (of_round(frame, finder(frame)) for frame in frames)
    assert two.kind is LoadKind.TWO
    assert two.probability[LoadKind.TWO] > 0.9
    assert two.probability[LoadKind.EDGE] == 0
    away = np.linalg.norm(np.asarray(two.two.position)[:, None] - pair(0.1, 0.08, 0.02, 0.7)[0], axis=2)
    assert away.min(0).max() < 0.003
    assert one.probability[LoadKind.ONE] > 0.9


@pytest.mark.parametrize("touch", [ring(0.08, 0.11, 0.015), tilted(0.11, 0.09, 0.5, 0.8)], ids=["ring", "tilted tip"])
def test_a_tip_that_is_no_gaussian_is_one(ready, touch):
    """Two loads near one another explain these frames better than a Gaussian does; they count as one."""
    fitter, finder, _, _ = ready
    frame = frames_of([touch] * len(TOUCHES), seed=3, spread=0.006)[0][0]
    found = fitter(frame, finder(frame))
    assert found.kind is LoadKind.ONE
    assert np.linalg.norm(np.asarray(found.one.position[0]) - touch[1] @ touch[0] / touch[1].sum()) < 0.002
    apart = eqx.tree_at(lambda f: f.belief.min_separation, fitter, jnp.full(2, 1e-4))
    assert found.probability[LoadKind.ONE] > apart(frame, finder(frame)).probability[LoadKind.ONE]


STRONG_TOUCHES = {
    "two": (LoadKind.TWO, pair(0.08, 0.045, 0.08, 0.8, 0.6, force=55.0)),
    "three, one weak": (LoadKind.MORE, (np.array([[0.03, 0.14], [0.15, 0.11], [0.08, 0.12]]), np.array([40, 60, 6.0]))),
}


@pytest.mark.parametrize(("kind", "touch"), STRONG_TOUCHES.values(), ids=STRONG_TOUCHES)
def test_loads_that_saturate_the_sheet_are_told(ready, kind, touch):
    """The finder overrates their forces, and the fit finds them from there."""
    fitter, finder, _, _ = ready
    frame = frames_of([touch] * len(TOUCHES), seed=4, spread=0.018)[0][0]
    contacts = finder(frame)
    assert np.asarray(contacts.present).sum() >= 2
    assert np.exp(fitter.starts.strongest(contacts, 2)[0][0, 3]) > 1.3 * touch[1].max()
    found = fitter(frame, contacts)
    assert found.kind is kind
    assert found.best.misfit < 1.4
    away = np.linalg.norm(np.asarray(found.best.position)[:, None] - touch[0], axis=2)
    assert away.min(0).max() < 0.006
    np.testing.assert_allclose(np.sort(found.best.force), np.sort(touch[1]), rtol=0.35)


def test_three_loads_of_which_two_are_near_are_two(ready):
    """Of the evidence of three, that of two near one another is evidence of two, and of all three of one."""
    fitter, _, frames, _ = ready
    frame = FrameFits(fitter.belief, fitter.whitened(frames[0], 0))
    for away, kind in (((0.008, 0.07), LoadKind.TWO), ((0.008, 0.016), LoadKind.ONE)):
        places = np.array([0.06, 0.1]) + np.array([[0.0, 0.0], [away[0], 0.0], [away[1], 0.0]])
        three = np.column_stack([places, np.full(3, np.log(0.012)), np.full(3, np.log(20.0))])
        loads, root = pad_rows(three), np.eye(len(frame.y))
        curved = np.diag(np.tile([1e6, 1e6, 10.0, 10.0, 0.0, 0.0], MAX_LOADS))  # places to 1 mm
        fits = {of: Fit(of, loads, 0.0, curved, root) for of in (LoadKind.ONE, LoadKind.TWO, LoadKind.MORE)}
        alone, found = log_evidence(frame.belief, fits[LoadKind.MORE]), evidences(frame, fits)
        assert found[LoadKind.MORE] < alone - 10
        own = evidences(frame, {of: fit for of, fit in fits.items() if of is not LoadKind.MORE})
        assert found[kind] == pytest.approx(np.logaddexp(own[kind], alone), abs=1e-3)


def test_a_blank_frame_holds_nothing(ready):
    fitter, finder, frames, noise = ready
    blank = noise * np.random.default_rng(5).normal(size=frames.shape[1])
    found = fitter(blank, finder(blank))
    assert found.kind is LoadKind.NONE
    assert found.best is None
    assert found.probability[0] == 1


GAUSSIAN = Spreading.at_depth(0.0, float)
SPOT = jnp.array([0.1, 0.1, np.log(0.01), np.log(7.0), 0.0, 0.0])
LONG = SPOT.at[4:].set(jnp.array([0.02, 0.01]))


def rows(*loads):
    """All rows of parameters, and their forms."""
    forms = [LoadForm.LONG if one[4:].any() else LoadForm.ROUND for one in loads] + [LoadForm.ABSENT] * (
        MAX_LOADS - len(loads)
    )
    return jnp.stack([*loads, *[SPOT] * (MAX_LOADS - len(loads))]), jnp.array(forms)


def grid_of_sheet(step=5e-4):
    axis = np.arange(0, 0.2, step) + step / 2
    return jnp.stack(jnp.meshgrid(axis, axis), -1), step**2


def test_pressure_of_loads_sums_to_their_force():
    points, area = grid_of_sheet()
    for one in (SPOT, LONG):
        assert float(jnp.sum(compiled(line, one, points)) * area) == pytest.approx(7.0, rel=1e-6)
    both = compiled(pressure, *rows(SPOT, LONG), points, GAUSSIAN)
    assert float(jnp.sum(both) * area) == pytest.approx(14.0, rel=1e-6)
    short = SPOT.at[4].set(1e-6)
    np.testing.assert_allclose(compiled(line, short, points), compiled(spot, SPOT, points), rtol=1e-4, atol=1.0)


def test_unknown_shapes_change_neither_force_nor_place_nor_width():
    """Moments by quadrature; and they are orthonormal with the Gaussian's inverse as weight."""
    points, area = grid_of_sheet()
    bent = np.asarray(compiled(shape_directions, *rows(SPOT), points))[..., : 2 + 4]
    away = (np.asarray(points) - 0.1) / 0.01
    for moment in (np.ones(points.shape[:2]), *np.moveaxis(away, -1, 0), (away**2).sum(-1)):
        total = np.einsum("xyd,xy->d", bent, moment) * area / 7.0
        np.testing.assert_allclose(total, 0, atol=1e-7)
    product = np.einsum("xyd,xye,xy->de", bent, bent, 1 / np.asarray(compiled(spot, SPOT, points))) * area / 7.0
    np.testing.assert_allclose(product[:4, :4], np.eye(4), atol=1e-6)
    assert product[4, 5] == pytest.approx(0, abs=1e-9)


def test_halves_of_a_split_load_have_the_moments_of_elongations():
    """To second order, two halves at d from the middle are the load plus elongations, at the same mean moment."""
    points, _ = grid_of_sheet()
    step = 0.15 * 0.01 * jnp.array([np.cos(0.4), np.sin(0.4)])
    width = 0.5 * jnp.log(jnp.exp(2 * SPOT[2]) - 0.5 * step @ step)
    halves = [SPOT.at[:2].add(way * step).at[2].set(width).at[3].add(-np.log(2.0)) for way in (1, -1)]
    change = np.asarray(compiled(pressure, *rows(*halves), points, GAUSSIAN) - compiled(spot, SPOT, points))
    u = np.asarray(step) / 0.01
    expected = np.asarray(compiled(elongations, SPOT, points)) @ np.array([(u[0] ** 2 - u[1] ** 2) / 2, u[0] * u[1]])
    assert np.abs(change - expected).max() < 0.05 * np.abs(expected).max()


STRONG = SPOT.at[2:4].set(jnp.log(jnp.array([0.02, 100.0])))


@pytest.mark.parametrize(
    ("loads", "most"),
    [
        ((SPOT,), 0.03),
        ((LONG,), 0.03),
        ((SPOT, SPOT.at[:2].set(0.07)), 0.03),
        ((STRONG.at[:2].set(jnp.array([0.06, 0.14])), SPOT), 0.15),
    ],
    ids=["one", "edge", "two", "two, one strong"],
)
def test_slopes_are_those_of_the_forward_map(ready, loads, most):
    """Against derivatives of the readings by JAX, through another path: `transfer` and all elements.

    A strong load saturates its middle, which then tells nothing of it, and takes elements from a weaker one.
    """
    sheet = ready[0].belief.sheet
    theta, forms = rows(*loads)
    by_jax = jax.jacfwd(lambda flat: sheet.response(flat, forms))(theta).reshape(-1, MAX_LOADS * LOAD_PARAMETERS)
    known = compiled(sheet.sensitivities, theta, forms)
    np.testing.assert_allclose(
        known.value, compiled(sheet.response, theta, forms), atol=1e-6 * float(jnp.abs(known.value).max())
    )
    used = np.flatnonzero(np.abs(by_jax).max(0) > 0)
    error = np.linalg.norm(known.loads - by_jax, axis=0)[used] / np.linalg.norm(by_jax, axis=0)[used]
    assert error.max() < most  # elements away from the loads are left out


@pytest.mark.slow
def test_what_is_not_known_of_the_coat_moves_the_readings_of_a_load(ready):
    """Slopes in the coat against differences of frames with and without the load."""
    fitter, _, _, noise = ready
    model = fitter.belief.sheet.model
    sheet = prepare_loads(model, noise=noise).belief.sheet
    theta, forms = rows(SPOT)
    white = jax.jit(lambda sigma: sheet.whiten(transfer(model, coefficients(model, sigma))))
    factor = sheet._conductivity(theta, forms) / sheet.sigma
    change = lambda mode: (lambda s: white(s * factor) - white(s))(sheet.sigma * jnp.exp(sheet.coat[:, mode]))  # noqa: E731
    slopes = compiled(sheet.sensitivities, theta, forms).nuisances[:, -sheet.coat.shape[1] :]
    strongest = int(jnp.argmax(jnp.linalg.norm(slopes, axis=0)))
    seen = change(strongest) - (white(sheet.sigma * factor) - white(sheet.sigma))
    assert np.linalg.norm(seen - slopes[:, strongest]) < 0.25 * np.linalg.norm(seen)


class Gain(AbstractGain):
    """A gain of the contact layer that is known: its mean at points, from which a mode differs as the settings say."""

    mean: Callable[[np.ndarray], np.ndarray]
    deviation: float

    def distribution(self, points):
        modes = LoadSettings().gain * field_modes(points, LoadSettings().gain_length)
        return self.mean(points), modes, self.deviation**2 * np.eye(modes.shape[1])


@pytest.mark.slow
def test_a_gain_of_which_nothing_is_known_changes_nothing(ready):
    """The errors of the readings by the modes of the gain, and the readings."""
    fitter, _, _, noise = ready
    model, sigma = fitter.belief.sheet.model, fitter.belief.sheet.sigma
    same = prepare_loads(
        model, noise=noise, sigma=sigma, gain=Gain(lambda points: np.zeros(len(points)), 1.0)
    ).belief.sheet
    theta, forms = rows(SPOT)
    one, other = (compiled(sheet.sensitivities, theta, forms) for sheet in (fitter.belief.sheet, same))
    np.testing.assert_allclose(other.value, one.value, atol=1e-9 * float(jnp.abs(one.value).max()))
    errors = [np.asarray(each.nuisances @ each.nuisances.T) for each in (one, other)]
    np.testing.assert_allclose(errors[1], errors[0], atol=1e-9 * np.abs(errors[0]).max())


def test_a_gain_that_is_even_and_known_is_a_factor_of_the_force(ready):
    """The law sees pressure times gain: half the force under twice the gain shows the same, and so do its slopes."""
    fitter, _, _, noise = ready
    model, sigma = fitter.belief.sheet.model, fitter.belief.sheet.sigma
    even = Gain(lambda points: np.full(len(points), np.log(2.0)), 1.0)
    twice = prepare_loads(model, noise=noise, sigma=sigma, gain=even).belief.sheet
    one, other = (
        compiled(sheet.sensitivities, *rows(SPOT.at[3].add(log)))
        for sheet, log in ((fitter.belief.sheet, 0.0), (twice, -np.log(2.0)))
    )
    for name in ("value", "loads", "shapes"):
        expected = np.asarray(getattr(one, name))
        np.testing.assert_allclose(getattr(other, name), expected, atol=1e-6 * np.abs(expected).max(), err_msg=name)


@pytest.mark.slow
def test_a_gain_that_is_known_places_loads_where_they_are(ready):
    """Frames of an uneven layer on another mesh, with the field that they were simulated by."""
    fitter, finder, _, noise = ready
    # With the noise of `ready` the corner is 0.7995 or 0.8005 mm off, as processors round.
    frames, _, _ = frames_of([touch for _, touch in TOUCHES.values()], seed=1)
    known = Gain(lambda points: float(GAIN.std) * np.asarray(GAIN._field(jnp.asarray(points))), 0.1)
    wiser = prepare_loads(fitter.belief.sheet.model, noise=noise, sigma=fitter.belief.sheet.sigma, gain=known)
    away = []
    for frame, (kind, (places, forces)) in zip(frames, TOUCHES.values(), strict=True):
        if kind in (LoadKind.ONE, LoadKind.TWO):
            found = [each(frame, finder(frame)) for each in (fitter, wiser)]
            assert found[1].kind is kind
            assert abs(found[1].best.force.sum() / forces.sum() - 1) < 0.05
            away.append(
                [np.linalg.norm(each.of(kind).position[:, None] - places, axis=-1).min(0).max() for each in found]
            )
    before, after = np.array(away).T
    assert after.max() < 0.8e-3
    assert after.mean() < 0.6 * before.mean()


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
        prepare_loads(fitter.belief.sheet.model, noise=noise, untouched=np.ones(550), sigma=fitter.belief.sheet.sigma)
    with pytest.raises(InverseError, match="give the 550 readings of one frame"):
        je.prepare_contacts(fitter.belief.sheet.model, noise=noise, untouched=np.ones(5))
    with pytest.raises(InverseError, match="reading 3 is not finite"):
        fitter(np.where(np.arange(550) == 3, np.nan, frames[0]), contacts)
    for bad in (
        {"width": 0.0},
        {"shapes": (-0.5,)},
        {"gain": -1.0},
        {"coat": -1.0},
        {"prior": (1.0, 0.0, 0.0)},
        {"prior": (0.5,) * 5},
    ):
        with pytest.raises(InverseError, match=next(iter(bad))):
            LoadSettings(**bad)


@pytest.mark.slow
def test_ellipses_hold_nine_of_ten_places():
    """Single touches anywhere, three sheets known from v0, on a mesh whose own error is small beside the gain's."""
    model = je.discretise(je.Scene(je.load_skin("testbed")), LOAD_FIDELITY)
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
