"""Loads by presses of known place and force: the law of pressure, the texture of the gain, and the model's error."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.contacts import ForceLaw, LoadKind, LoadSettings, learn_loads, prepare_loads
from jaxeit.contacts.loads.fits.comparison import load_shape
from jaxeit.contacts.loads.fits.kinds import Fit, FrameFits
from jaxeit.contacts.loads.learned import learning
from jaxeit.contacts.loads.learned.model_error import ERROR_RATIO, MAX_ERROR, select_model_error
from jaxeit.contacts.loads.search import FrameSearch
from jaxeit.contacts.loads.sheet import scaled_law
from jaxeit.imaging import InverseError
from tests.compiled import compiled

from .test_loads import LONG, SPOT, rows
from .touches import TOUCHES, frames_of, single

PLACES = np.array([[0.04, 0.05], [0.10, 0.06], [0.15, 0.05], [0.06, 0.11], [0.13, 0.12], [0.05, 0.16], [0.14, 0.15]])
FORCES = np.array([20.0, 10.0, 12.0, 9.0, 24.0, 15.0, 8.0])  # weak ones hardly tell how far a model errs
LAW = (2.0, 35e3, 1.0)  # not the usual one
PRESSURES = np.array([3e3, 10e3, 20e3, 30e3])  # Pa, under such presses


def change(law):
    """Relative change of the conductivity by `PRESSURES`."""
    return np.asarray(law.factor(jnp.asarray(PRESSURES))) - 1


def presses_under(law, seed=8):
    assert len(PLACES) == len(TOUCHES)  # as many frames as elsewhere: compiled once
    return frames_of([single(*place, force) for place, force in zip(PLACES, FORCES, strict=True)], seed=seed, law=law)


def forces_alone(model, settings, frames, **sheet):
    """Log of the force of one load that the readings of each frame tell, over the true one."""
    fitter, finder = prepare_loads(model, settings, **sheet), je.prepare_contacts(model, **sheet)
    return np.array([single_load(fitter, finder, frame)[1].loads[0, 3] for frame in frames]) - np.log(FORCES)


def single_load(fitter, finder, frame):
    """The fits to a frame, and the best one of a single load."""
    fits = FrameFits(fitter.belief, fitter.whitened(frame, 0))
    return fits, FrameSearch(fits, fitter.starts, finder(frame)).one()


def test_the_law_is_learned_that_the_presses_follow(ready, monkeypatch):
    """On a mesh, a coat and a gain that the fit does not know."""
    monkeypatch.setattr(learning, "TEXTURES", (0.0,))  # a scene without protrusions
    model = ready[0].belief.sheet.model
    frames, noise, blank = presses_under(LAW)
    sheet = {"noise": noise, "sigma": je.fit_background(model, blank)}
    learned = learn_loads(model, frames, PLACES, FORCES, **sheet)
    truth, usual = change(je.effects.ContactPiezoresistance(*LAW)), change(LoadSettings().law)
    assert np.abs(np.log(change(learned.law) / truth)).max() < 0.12  # a gain of 0.12 over 7 presses: 0.05
    assert np.abs(np.log(usual / truth)).max() > 0.2
    assert learned.model_error < 2.1 * LoadSettings().model_error
    assert learned.changed().startswith("law = ContactPiezoresistance")


@pytest.mark.slow
def test_readings_alone_then_tell_nearly_the_true_forces(ready, monkeypatch):
    monkeypatch.setattr(learning, "TEXTURES", (0.0,))
    model = ready[0].belief.sheet.model
    frames, noise, blank = presses_under(LAW)
    sheet = {"noise": noise, "sigma": je.fit_background(model, blank)}
    learned = learn_loads(model, frames, PLACES, FORCES, **sheet)
    before, after = (forces_alone(model, one, frames, **sheet) for one in (LoadSettings(), learned))
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))


@pytest.mark.slow
def test_a_law_that_is_right_stays_and_has_no_texture(ready):
    model = ready[0].belief.sheet.model
    frames, noise, blank = presses_under((1.0, 20e3, 1.0))
    learned = learn_loads(model, frames, PLACES, FORCES, noise=noise, untouched=blank)
    assert np.abs(np.log(change(learned.law) / change(LoadSettings().law))).max() < 0.12
    assert learned.texture == 0
    assert learned.model_error < 2.1 * LoadSettings().model_error


@pytest.mark.slow
def test_a_frame_that_is_not_of_its_press_is_left_out(ready, monkeypatch):
    """One frame in seven is that of a press at the other end of the sheet."""
    monkeypatch.setattr(learning, "TEXTURES", (0.0,))
    model = ready[0].belief.sheet.model
    frames, noise, blank = presses_under(LAW)
    mixed = np.where(np.arange(len(FORCES))[:, None] == 1, frames[6], frames)
    learned = learn_loads(model, mixed, PLACES, FORCES, noise=noise, untouched=blank)
    truth = change(je.effects.ContactPiezoresistance(*LAW))
    assert np.abs(np.log(change(learned.law) / truth)).max() < 0.15


def test_forces_are_told_by_the_law_that_single_presses_follow(monkeypatch):
    """A regression on the slopes of found forces: the law is found, one wrong force in sixteen counts little, and the
    scatter of the others is the stated one."""
    rng, truth = np.random.default_rng(3), np.array([0.2, -0.1, 0.25])
    slopes = rng.uniform([1.0, -1.1, -2.0], [1.5, -0.9, -0.4], (64, 3))
    missed = slopes @ truth + 0.07 * rng.normal(size=64)
    missed[5] += np.log(5)
    law = learning.fit_force_law(missed, np.full(64, 0.14**2), slopes)
    off = slopes @ (np.array(law.logs) - truth)
    assert np.abs(off).max() < 0.06
    stated = np.sqrt(np.einsum("ni,ij,nj->n", slopes, np.array(law.covariance), slopes))
    assert np.abs(off / stated).max() < 2
    assert law.variance == pytest.approx(0.3, rel=0.4)  # half the stated deviation; without the one, a quarter
    assert "exponent times 1." in str(law)


def test_a_force_is_told_by_its_law_and_the_rest_of_a_load_stays(ready):
    """To first order, as a fit under that law tells it."""
    fitter, finder, frames, _ = ready
    (plainly, fit), logs = single_load(fitter, finder, frames[0]), np.array([0.02, -0.01, 0.015])
    law = replace(
        fitter.belief, force_logs=jnp.asarray(logs), force_covariance=0.01 * jnp.eye(3), force_variance=jnp.asarray(0.5)
    )
    told, plain = load_shape(FrameFits(law, plainly.y), fit), load_shape(plainly, fit)
    np.testing.assert_array_equal(told.position, plain.position)
    np.testing.assert_array_equal(told.width, plain.width)
    np.testing.assert_allclose(told.position_covariance, plain.position_covariance, rtol=1e-12)
    assert told.covariance[3, 3] > 0.5 * plain.covariance[3, 3]
    sheet = replace(fitter.belief.sheet, law=scaled_law(fitter.belief.sheet.law, logs.tolist()))
    other = FrameFits(replace(fitter.belief, sheet=sheet), plainly.y).fit(LoadKind.ONE, fit.rows[:, :4], 1e-6)
    again = plainly.fit(LoadKind.ONE, fit.rows[:, :4], 1e-6)
    change = other.loads[0, 3] - again.loads[0, 3]
    assert np.log(told.force[0] / plain.force[0]) == pytest.approx(change, rel=0.2)
    assert abs(change) > 0.01


@pytest.mark.parametrize("wrong", [{"logs": (0.1, 0.2)}, {"variance": 0.0}, {"logs": (np.nan, 0.0, 0.0)}])
def test_a_law_of_forces_is_three_finite_logs(wrong):
    with pytest.raises(InverseError, match="are no law of forces; give three finite logs"):
        ForceLaw(**wrong)


@pytest.mark.parametrize("loads", [(SPOT,), (LONG,)], ids=["one", "edge"])
def test_slopes_in_the_law_are_those_of_the_forward_map(ready, loads):
    """Against differences of the readings under laws that differ a little."""
    sheet, (theta, forms) = ready[0].belief.sheet, rows(*loads)
    slopes = np.asarray(compiled(sheet.sensitivities, theta, forms).law)
    step, parts = 1e-4, [float(part) for part in jax.tree.leaves(sheet.law)]
    for k in range(3):
        up, down = (
            _responses(sheet, [part * np.exp(sign * step * (i == k)) for i, part in enumerate(parts)], theta, forms)
            for sign in (1, -1)
        )
        by_differences = (up - down) / (2 * step)
        error = np.linalg.norm(slopes[:, k] - by_differences) / np.linalg.norm(by_differences)
        assert error < 0.03  # elements away from the loads are left out


def _responses(sheet, parts, theta, forms):
    return np.asarray(compiled(_response, sheet, je.effects.ContactPiezoresistance(*parts), theta, forms))


def _response(sheet, law, theta, forms):
    return replace(sheet, law=law).response(theta, forms)


def test_a_texture_is_an_error_that_a_frame_does_not_tell(ready):
    """Larger textures make the place of a load less sure, and no reading another one."""
    fitter, _, _, noise = ready
    sheet = {"noise": noise, "sigma": fitter.belief.sheet.sigma}
    rough = prepare_loads(fitter.belief.sheet.model, LoadSettings(texture=0.2), **sheet)
    theta, forms = rows(SPOT)
    plain, known = (compiled(one.belief.sheet.sensitivities, theta, forms) for one in (fitter, rough))
    np.testing.assert_allclose(known.value, plain.value, rtol=1e-12)
    added = np.asarray(known.nuisances) @ np.asarray(known.nuisances).T
    added -= np.asarray(plain.nuisances) @ np.asarray(plain.nuisances).T
    values = np.linalg.eigvalsh(added)
    assert values.min() > -1e-9 * values.max()
    assert values.max() > 1  # of the variance of the noise


def test_presses_that_tell_no_law_are_refused(ready):
    model, frames = ready[0].belief.sheet.model, np.zeros((7, 550))
    noise = ready[3]
    with pytest.raises(InverseError, match=r"dv \(3, 550\), position .* give 6 presses or more"):
        learn_loads(model, frames[:3], PLACES[:3], FORCES[:3], noise=noise)
    with pytest.raises(InverseError, match=r"position \(6, 2\)"):
        learn_loads(model, frames, PLACES[:6], FORCES, noise=noise)
    with pytest.raises(InverseError, match=r"press 2 has place .* force 0.0 N"):
        learn_loads(model, frames, PLACES, np.where(np.arange(7) == 2, 0.0, FORCES), noise=noise)
    with pytest.raises(InverseError, match="force is a masked array"):
        learn_loads(model, frames, PLACES, np.ma.masked_equal(FORCES, FORCES[2]), noise=noise)
    with pytest.raises(InverseError, match="press 4 has place"):
        learn_loads(model, frames, np.where(np.arange(7)[:, None] == 4, np.nan, PLACES), FORCES, noise=noise)
    with pytest.raises(InverseError, match="learn_loads decides by looking at values"):
        jax.jit(lambda dv: learn_loads(model, dv, PLACES, FORCES, noise=noise).gain)(frames)


def test_the_error_is_that_which_nine_of_ten_frames_stay_below():
    """Of frames whose evidence is largest at an error of their own."""

    def frame(own):
        return lambda error: -100 * np.log(error / own) ** 2

    own = 0.01 * ERROR_RATIO ** np.array([0, 1, 1, 2, 2, 2, 3, 3, 4, 6])
    assert select_model_error([frame(one) for one in own], 0.01) == pytest.approx(0.01 * ERROR_RATIO**6)
    assert select_model_error([frame(one) for one in own[:-1]] * 2, 0.01) == pytest.approx(0.01 * ERROR_RATIO**4)
    assert select_model_error([frame(1.0)], 0.01) == pytest.approx(MAX_ERROR, rel=0.4)
    assert select_model_error([frame(1e-9)], 0.0) == pytest.approx(1e-3)  # no error at all cannot be tried


def test_frames_of_which_no_fit_converges_tell_no_error():
    with pytest.raises(InverseError, match=r"fitted to 1 of 2 frames, .* frames \[1\]"):
        select_model_error([lambda error: -error, lambda error: -np.inf], 0.01)


@pytest.mark.slow
def test_a_fitter_of_a_texture_tells_one_tip_as_one(ready):
    fitter, finder, frames, noise = ready
    rough = prepare_loads(
        fitter.belief.sheet.model,
        LoadSettings(texture=0.2, model_error=0.01),
        noise=noise,
        sigma=fitter.belief.sheet.sigma,
    )
    assert rough(frames[0], finder(frames[0])).kind is LoadKind.ONE


def test_presses_of_one_force_tell_no_law_of_forces(ready, monkeypatch):
    fitter, frames = ready[0], np.zeros((7, 550))
    monkeypatch.setattr(learning, "prepare_loads", lambda *_, **__: fitter)
    monkeypatch.setattr(
        learning, "_fit_law", lambda *_: (np.zeros(3), [Fit(LoadKind.ONE, np.zeros((3, 6)), 0.0, None, None)])
    )
    monkeypatch.setattr(learning, "_model_error", lambda *_: (0.01, np.zeros(7)))
    monkeypatch.setattr(learning, "_force_law", lambda *_: ForceLaw(logs=(0.1, 0.0, 0.0)))
    for most, logs in ((19.9, (0.0, 0.0, 0.0)), (20.1, (0.1, 0.0, 0.0))):
        forces = np.linspace(10.0, most, 7)
        assert learn_loads(fitter.belief.sheet.model, frames, PLACES, forces, noise=ready[3]).forces.logs == logs


def test_presses_that_tell_nothing_are_not_counted(ready, monkeypatch):
    """The texture is that under which the others are most probable."""
    fitter, _, frames, noise = ready
    nothing = -np.inf

    def told(evidences):
        found = iter(evidences)
        monkeypatch.setattr(learning, "prepare_loads", lambda *_, **__: fitter)
        monkeypatch.setattr(
            learning, "_fit_law", lambda *_: (np.zeros(3), [Fit(LoadKind.ONE, np.zeros((3, 6)), 0.0, None, None)])
        )
        monkeypatch.setattr(learning, "_force_law", lambda *_: ForceLaw())
        monkeypatch.setattr(learning, "_model_error", lambda *_: (0.01, np.array([*next(found), *np.zeros(5)])))
        return learn_loads(fitter.belief.sheet.model, frames, PLACES, FORCES, noise=noise)

    assert told([(nothing, -10.0), (-99.0, -5.0), (nothing, -9.0)]).texture == learning.TEXTURES[1]
    assert told([(-1.0, -10.0), (nothing, -5.0)]).texture == 0  # told before, and not any longer
    assert told([(np.nan, -10.0), (0.0, -12.0)]).texture == 0
