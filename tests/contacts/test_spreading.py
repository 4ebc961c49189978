"""Loads that the skin spreads, against the half-space that the sum of Gaussians stands for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxeit as je
from jaxeit.contacts.loads.fits.comparison import load_shape
from jaxeit.contacts.loads.fits.kinds import FrameFits
from jaxeit.contacts.loads.pressure import spot
from jaxeit.contacts.loads.search import FrameSearch
from jaxeit.contacts.loads.spreading import Spreading

from .touches import frames_of, single

DEPTH = 0.01  # m


def ring_integral(density):
    """Integral over the plane of a density of the distance, m."""
    return 2 * np.pi * quad(lambda r: r * density(r), 0, 50 * DEPTH, points=[DEPTH, 5 * DEPTH], limit=200)[0]


def on_axis(spreading, load):
    """Pressure (n,) Pa at distances (n,) m."""
    points = lambda r: jnp.stack([r, jnp.zeros_like(r)], -1)  # noqa: E731
    found = jax.jit(lambda r: spreading.pressure(spot, load, points(r)))
    return lambda r: np.asarray(found(jnp.atleast_1d(jnp.asarray(r, float))))


def test_a_point_load_becomes_that_of_boussinesq():
    spreading = Spreading.at_depth(DEPTH, float)
    shares, variances = np.asarray(spreading.shares), np.asarray(spreading.variances)
    assert shares.sum() == pytest.approx(1, rel=1e-12)

    def found(r):
        return float(shares @ (np.exp(-0.5 * r**2 / variances) / (2 * np.pi * variances)))

    def true(r):
        return 3 * DEPTH**3 / (2 * np.pi * (r**2 + DEPTH**2) ** 2.5)

    assert ring_integral(true) == pytest.approx(1, abs=1e-4)
    assert ring_integral(lambda r: abs(found(r) - true(r))) < 0.009
    assert max(abs(found(r) - true(r)) for r in np.linspace(0, 5 * DEPTH, 200)) < 0.002 * true(0.0)


@pytest.mark.parametrize("diameter", [0.005, 0.01, 0.02])
def test_a_flat_tip_is_near_a_load_that_is_spread(skin, diameter):
    """At most half as far from it as the best Gaussian is. A tip of 30 mm is as far from both: it is no point load."""
    scene = je.Scene(skin, (je.effects.IndentationSpreading(DEPTH),))
    model, middle = je.discretise(scene, je.Fidelity.draft()), np.array([0.1, 0.1])
    r = np.linspace(0, 0.08, 400)
    true = np.asarray(je.model.load_spread(model, middle, diameter, jnp.asarray(middle + np.outer(r, [1.0, 0.0]))))
    widths = np.linspace(0.003, 0.02, 100)

    def least_error(depth):
        spread = Spreading.at_depth(depth, float)
        each = [on_axis(spread, jnp.array([0, 0, np.log(width), 0, 0, 0]))(r) for width in widths]
        return min(float(np.trapezoid(2 * np.pi * r * np.abs(one - true), r)) for one in each)

    assert least_error(DEPTH) < min(0.05, 0.5 * least_error(0.0))


def test_without_depth_a_load_stays_as_it_is():
    load = jnp.array([0.0, 0.0, np.log(0.008), np.log(7.0), 0, 0])
    rows, slopes = Spreading.at_depth(0.0, float).parts(load)
    np.testing.assert_allclose(rows, load[None], rtol=1e-14)
    np.testing.assert_allclose(slopes, [1.0], rtol=1e-14)


def test_a_width_is_that_on_the_sheet():
    """Of all loads, the one that a narrow tip makes is nearest to the Gaussian of its stated width."""
    spreading, width = Spreading.at_depth(DEPTH, float), 0.008
    rows, _ = spreading.parts(jnp.array([0.0, 0.0, np.log(width), 0.0, 0, 0]))
    tip = np.exp(2 * np.asarray(rows[:, 2])) - np.asarray(spreading.variances)
    assert np.ptp(tip) < 1e-12 * tip[0]  # the same for all parts
    assert tip[0] == pytest.approx(width**2 - float(spreading.core), rel=0.03)


def test_a_load_of_a_half_space_is_explained_at_its_depth(ready):
    """To the noise, and far better than by a Gaussian, whose shape may differ by its moments."""
    fitter, places = ready[0], np.array([[0.13, 0.05], [0.09, 0.09]])
    frames, _, _ = frames_of(
        [single(*place) for place in places], spread=je.effects.IndentationSpreading(DEPTH), diameters=0.01
    )
    deep = eqx.tree_at(lambda f: f.belief.sheet.spreading, fitter, Spreading.at_depth(DEPTH, fitter.belief.low.dtype))
    flat, spread = ([one_load(each, frame) for frame in frames] for each in (fitter, deep))
    assert max(shape.misfit for shape in spread) < 1.1
    falls = [one.misfit - other.misfit for one, other in zip(flat, spread, strict=True)]
    assert min(falls) * len(fitter.whitened(frames[0], 0)) > 30  # of chi-square, with as many parameters
    away = [np.linalg.norm(shape.position[0] - place) for shape, place in zip(spread, places, strict=True)]
    assert max(away) < 1e-3


def one_load(fitter, frame):
    """The single load that explains a frame best."""
    fit = FrameFits(fitter.belief, fitter.whitened(frame, 0))
    return load_shape(fit, FrameSearch(fit, fitter.starts, None).one())
