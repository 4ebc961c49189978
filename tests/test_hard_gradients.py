"""Derivatives of every public verb: right where it is smooth, finite at its kinks, the same however it is called.

A verb that is new must be listed: with a case, or with the reason why it has no derivative.
"""

import hashlib
import subprocess
import sys
from collections.abc import Callable
from inspect import isclass
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je

from .helpers import spread_stacks, square_model

_DESCRIBES = "describes hardware, or reads or writes files: on the host"
_GEOMETRY = "geometry, on the host: its arrays are constants of a model"
_PREPARES = (
    "prepares or chooses once, on the host: it looks at values to refuse them, and hands out what has derivatives"
)
HOST = {
    "adjacent": _DESCRIBES,
    "bind": "what it is given has",
    "choose_readings": _PREPARES,
    "compiler_options": _DESCRIBES,
    "discretise": _GEOMETRY,
    "disc_resistance": "one number, on the host; in the forward map it is `series_resistance`, case 'forward'",
    "drives": _DESCRIBES,
    "few_choices": _PREPARES,
    "fidelity_choices": _PREPARES,
    "find_regions": "regions of an image are counted, on the host",
    "fit_background": _PREPARES,
    "fit_fidelity": _PREPARES,
    "from_numbers": _DESCRIBES,
    "gauss_newton": "its steps are chosen on the host",
    "image_choices": _PREPARES,
    "ktc_score": "labels are integers; structural_similarity has the derivative",
    "ladder": _PREPARES,
    "load_reconstructor": _DESCRIBES,
    "load_skin": _DESCRIBES,
    "make_mesh": _GEOMETRY,
    "noise_covariance": _PREPARES,
    "pad_masks": _GEOMETRY,
    "pad_response": _GEOMETRY,
    "parse_skin": _DESCRIBES,
    "parse_toml": _DESCRIBES,
    "prepare": _PREPARES,
    "prepare_contacts": _PREPARES,
    "prepare_event_scan": _PREPARES,
    "read_effects": _DESCRIBES,
    "read_text": _DESCRIBES,
    "reciprocal_rows": _DESCRIBES,
    "refine_contacts": _PREPARES,
    "reuse_memory": _DESCRIBES,
    "rounding": "what it estimates has no direction",
    "save_reconstructor": _DESCRIBES,
    "scan_time": _DESCRIBES,
    "shipped_skins": _DESCRIBES,
    "shortened": _DESCRIBES,
    "signal_covariance": _PREPARES,
    "structured": _GEOMETRY,
    "to_numbers": _DESCRIBES,
    "triangulate": _GEOMETRY,
    "AbstractSurface": _GEOMETRY,
    "Cylinder": _GEOMETRY,
    "Sphere": _GEOMETRY,
    "verb": "a decorator",
}


class Case(NamedTuple):
    """A verb as a function of one vector; smooth points, where the derivative is checked, and kinks."""

    function: Callable
    smooth: list
    kinks: list


POINTS = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15), (0.1, 0.1), (0.1, 0.0)]
SIDE = 4
PIXELS = SIDE**2


@pytest.fixture(scope="module")
def tiny():
    """Six electrodes, 32 triangles, 16 pixels; and the same with a pad between the tip and the sheet."""
    model = square_model(POINTS, je.adjacent(6), SIDE)
    felt = (je.LoadSpreading(), je.ContactPiezoresistance())
    pressed = square_model(POINTS, je.adjacent(6), SIDE, effects=felt)
    basis = je.Pixels(SIDE).on(model)
    rng = np.random.default_rng(0)
    return SimpleNamespace(
        model=model, pressed=pressed, basis=basis, rng=rng, draw=lambda n: jnp.asarray(rng.normal(size=n))
    )


def _forward(t):
    even = t.model.background
    return Case(lambda s: je.forward(t.model, s), [even, even * jnp.exp(t.draw(32))], [])


def _conductivity(t):
    """Through to the readings: from no pressure at all, zero touch."""

    def readings(pressure):
        return je.forward(t.pressed, je.conductivity(t.pressed, pressure))

    return Case(readings, [1e4 * jnp.exp(t.draw(32))], [jnp.zeros(32)])


def _load_spread(t):
    def pressure(x):
        return je.load_spread(t.pressed, x[:2], x[2])

    return Case(pressure, [jnp.array([0.07, 0.12, 0.02])], [jnp.append(t.model.centroids[9], 0.02)])


def _jacobian(t):
    even = t.model.background
    return Case(lambda s: je.jacobian(t.model, s, t.basis), [even, even * jnp.exp(t.draw(32))], [])


def _fuse(t):
    half = (jnp.arange(PIXELS) < PIXELS // 2).astype(float)
    masks = je.PadMasks(jnp.stack([half, 1 - half]), t.basis.areas)
    image = jnp.abs(t.draw(PIXELS))

    def force(x):
        return je.fuse(x[:PIXELS], masks, x[PIXELS:]).force

    def at(image, *forces):
        return jnp.append(image, jnp.array(forces))

    nothing = jnp.zeros(PIXELS)
    kinks = [at(nothing, 3, 2), at(nothing, 0, 0), at(image, 0, -1), at(-image, 3, 2), at(image, jnp.nan, 2)]
    return Case(force, [at(image, 3, 2)], [*kinks, at(image.at[3].set(jnp.nan), 3, 2)])


def _contact_shares(t):
    """Of two contacts on two pads; alike, on a corner of a pixel, absent, of no width."""
    half = (jnp.arange(PIXELS) < PIXELS // 2).astype(float)
    masks = je.PadMasks(jnp.stack([half, 1 - half]), t.basis.areas)

    def shares(x):
        found = je.contact_shares(x[:4].reshape(2, 2), x[4:6], x[6:], t.basis.centres, masks)
        return jnp.append(found.part, found.share)

    apart = jnp.array([0.06, 0.08, 0.14, 0.13, 0.03, 0.05, 2.0, 1.0])
    alike = jnp.array([0.1, 0.1, 0.1, 0.1, 0.03, 0.03, 1.0, 1.0])
    kinks = [alike, alike.at[6].set(0), alike.at[6:].set(0), alike.at[4].set(0), alike.at[0].set(jnp.nan)]
    return Case(shares, [apart], kinks)


def _reconstructor(t, *how, **settings):
    recon = je.prepare(t.model, *how, basis=t.basis, **settings)
    dv, n = t.draw(recon.readings), recon.readings
    gaps = [dv.at[2].set(jnp.nan), jnp.full(n, jnp.inf)]
    return Case(recon, [dv], [jnp.zeros(n), jnp.ones(n), -dv, 1e-100 * dv, *gaps])


def _estimator(estimator):
    def case(t):
        image, same = t.draw(PIXELS), jnp.ones(PIXELS)
        return Case(lambda x: estimator(x, t.basis), [image], [0 * same, same, -same, image.at[3].set(jnp.nan)])

    return case


def _length(t):
    here, there = jnp.array([0.1, 0.2, 0.13, 0.16]), jnp.array([0.1, 0.2, 0.1, 0.2])
    return Case(lambda x: je.localisation_error(x[:2], x[2:]), [here], [there])


def _bias(t):
    centre = jnp.array([0.1, 0.1])
    kinks = [jnp.tile(centre, 2)]
    return Case(lambda x: je.inward_bias(x[:2], x[2:], centre), [jnp.array([0.11, 0.12, 0.13, 0.16])], kinks)


def _variation(t):
    values = jnp.abs(t.draw(5)) + 1
    return Case(lambda x: je.coefficient_of_variation(x, ddof=1), [values], [jnp.ones(5), jnp.zeros(5)])


def _greit(t):
    def figures(x):
        found = je.greit_figures(x, t.basis, jnp.array([0.1, 0.1]), jnp.array([0.1, 0.1]))
        return jnp.stack([found.amplitude, found.position_error, found.resolution, found.ringing])

    image, same = t.draw(PIXELS), jnp.ones(PIXELS)
    return Case(figures, [image], [0 * same, same, -same])


def _correlation(t):
    truth, same = t.draw(PIXELS), jnp.ones(PIXELS)
    return Case(
        lambda x: je.image_correlation(x, truth, t.basis.areas),
        [t.draw(PIXELS)],
        [0 * same, same, truth, 1e-3 * truth],
    )


def _similarity(t):
    truth, same = t.draw(PIXELS), jnp.ones(PIXELS)

    def like(x):
        return je.structural_similarity(x.reshape(SIDE, SIDE), truth.reshape(SIDE, SIDE), width=1.0)

    return Case(like, [t.draw(PIXELS)], [0 * same, same, truth])


def _otsu(t):
    values = t.draw(PIXELS)
    kinks = [jnp.zeros(PIXELS), jnp.ones(PIXELS), values.at[2].set(jnp.inf)]
    return Case(lambda x: je.otsu_thresholds(x, 3, bins=16), [values], kinks)


def _contacts(t):
    def place(x):
        fields = je.Contacts(x[:1] > 0, x[1:3][None], *[jnp.ones(1)] * 2, jnp.ones((1, 4, 4)), x[0], jnp.zeros(1, int))
        return jnp.append(je.strongest(fields), fields.strength)

    return Case(place, [jnp.array([1.0, 0.1, 0.2])], [jnp.array([0.0, 0.1, 0.2])])


def _penalty(penalty):
    def case(t):
        return Case(
            lambda x: penalty.value(t.basis.picture, x), [t.draw(PIXELS)], [jnp.zeros(PIXELS), jnp.ones(PIXELS)]
        )

    return case


def _log_conductivity(t):
    physics = je.LogConductivity(t.model, t.basis, t.model.background[0])
    return Case(physics.voltages, [jnp.zeros(PIXELS), t.draw(PIXELS)], [])


CASES = {
    "forward": _forward,
    "conductivity": _conductivity,
    "load_spread": _load_spread,
    "jacobian": _jacobian,
    "fuse": _fuse,
    "contact_shares": _contact_shares,
    "Reconstructor": _reconstructor,
    "IterativeReconstructor": lambda t: _reconstructor(t, je.Noser(), je.NonNegative()),
    "IterativeReconstructor, interior point": lambda t: _reconstructor(t, je.Laplace(), je.NonNegative(20)),
    "IterativeReconstructor, variation": lambda t: _reconstructor(t, je.TotalVariation(), je.Reweighted(3)),
    "IterativeReconstructor, sparse": lambda t: _reconstructor(t, je.Tikhonov(), je.SparseBayes(4)),
    "Peak": _estimator(je.Peak()),
    "LevelCentroid": _estimator(je.LevelCentroid()),
    "PositiveCentroid": _estimator(je.PositiveCentroid()),
    "localisation_error": _length,
    "inward_bias": _bias,
    "image_sum": lambda t: Case(lambda x: je.image_sum(x, t.basis.areas), [t.draw(PIXELS)], [jnp.zeros(PIXELS)]),
    "coefficient_of_variation": _variation,
    "greit_figures": _greit,
    "image_correlation": _correlation,
    "structural_similarity": _similarity,
    "otsu_thresholds": _otsu,
    "strongest": _contacts,
    "around": lambda t: Case(lambda x: je.around(t.basis, x, 0.02), [jnp.array([0.07, 0.12])], [t.basis.centres[3]]),
    "in_frame": lambda t: Case(lambda x: je.in_frame(x, jnp.array([1, 4]), 6), [t.draw(2)], [jnp.zeros(2)]),
    "IsotropicVariation": _penalty(je.IsotropicVariation()),
    "LogConductivity": _log_conductivity,
}
# Compiled by a dozen programs: seconds each.
SLOW = {name for name in CASES if name.startswith(("Iterative", "Reconstructor", "jacobian", "Log", "conductivity"))}
ELSEWHERE = {
    "ContactFinder": "below, and in tests/test_contacts.py",
    "least_squares_image": "in tests/test_nonlinear.py",
}


def test_every_verb_is_listed():
    effects = {
        name for name in je.__all__ if isclass(getattr(je, name)) and issubclass(getattr(je, name), je.AbstractEffect)
    }
    verbs = {name for name in je.__all__ if _is_called(getattr(je, name))} - effects  # those have tests of their own
    listed = {name.split(",")[0] for name in CASES} | set(HOST) | set(ELSEWHERE)
    assert not verbs - listed, "new: give it a case, or say why it has no derivative"
    assert listed <= set(je.__all__), "no longer public"


def _is_called(public):
    return any("__call__" in vars(c) for c in public.__mro__) if isclass(public) else callable(public)


def _program(case):
    """Value, derivative along a direction, and gradient, of a weighted sum of whatever is finite."""

    def numbers(x, along):
        def total(x):
            out = jnp.ravel(case.function(x))
            weight = jnp.cos(1.0 + jnp.arange(out.size))
            return jnp.sum(jnp.where(jnp.isfinite(out), out * weight, 0))

        value, slope = jax.jvp(total, (x,), (along,))
        return value, slope, jax.grad(total)(x)

    return numbers


def _marked(slow):
    return [pytest.param(name, marks=pytest.mark.slow) if name in slow else name for name in CASES]


@pytest.mark.parametrize("name", _marked(SLOW))
def test_derivatives_are_right_and_finite(hard, tiny, name):
    case = CASES[name](tiny)
    program = jax.jit(_program(case))
    worst = 0.0
    for x in case.smooth:
        along = jnp.abs(x) * jnp.asarray(np.random.default_rng(1).normal(size=x.size)) + (x == 0)
        value, slope, gradient = program(x, along)
        assert float(jnp.vdot(gradient, along)) == pytest.approx(float(slope), rel=1e-7, abs=1e-9 * abs(float(value)))
        steps = [(program(x + h * along, along)[0] - program(x - h * along, along)[0]) / (2 * h) for h in (1e-4, 2e-4)]
        difference = (4 * steps[0] - steps[1]) / 3
        size = max(abs(float(difference)), 1e-3 * abs(float(value)), 1e-12)
        worst = max(worst, abs(float(slope - difference)) / size)
    assert worst < 1e-5
    for x in case.kinks:
        value, slope, gradient = program(x, jnp.ones_like(x))
        assert np.isfinite(value)
        assert np.isfinite(slope)
        assert np.isfinite(gradient).all()
    said = "derivatives are finite, zero or one-sided at a kink"
    hard("gradients of public verbs", f"{len(CASES)} verbs, kinks included", float64=worst, beyond=said)


@pytest.mark.parametrize("name", _marked(set(CASES) - {"fuse", "Peak", "coefficient_of_variation"}))
def test_jit_vmap_and_plain_python_agree(tiny, name):
    case = CASES[name](tiny)
    points = [*case.smooth, *case.kinks]
    along = jnp.ones_like(points[0])
    program = _program(case)
    batch = jax.jit(jax.vmap(program, (0, None)))(jnp.stack(points), along)
    compiled = jax.jit(program)
    for k, x in enumerate(points):
        alone = compiled(x, along)
        for found, expected in zip(batch, alone, strict=True):
            np.testing.assert_allclose(found[k], expected, rtol=1e-8, atol=1e-9 * float(jnp.max(jnp.abs(found))))
    if name not in SLOW | {"forward"}:  # thousands of programs of one line each
        with jax.disable_jit():
            plain = program(points[0], along)
        for found, expected in zip(plain, compiled(points[0], along), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * float(jnp.max(jnp.abs(expected))))


@pytest.mark.parametrize("name", CASES)
def test_no_stack_of_matrices_is_spread_over_threads_that_wait_for_it(tiny, name):
    """However many are mapped at once; see `jaxeit.lapack`."""
    case = CASES[name](tiny)
    many = jax.ShapeDtypeStruct((1_000_000, case.smooth[0].size), jnp.float64)
    along = jnp.ones_like(case.smooth[0])
    assert not spread_stacks(jax.jit(jax.vmap(_program(case), (0, None))).lower(many, along).as_text())


@pytest.mark.slow
def test_second_derivatives_of_the_forward_map(hard, tiny):
    """The curvature along a direction, against differences of the first: on an even sheet, and at zero contrast."""
    weight = jnp.cos(jnp.arange(tiny.model.pattern.shape[0]))
    along = tiny.draw(32)

    def slope(x):
        return jax.grad(lambda x: weight @ je.forward(tiny.model, tiny.model.background * jnp.exp(x)))(x)

    program = jax.jit(lambda x: (slope(x), jax.jvp(slope, (x,), (along,))[1]))
    worst = 0.0
    for x in (jnp.zeros(32), tiny.draw(32)):
        steps = [(program(x + h * along)[0] - program(x - h * along)[0]) / (2 * h) for h in (1e-3, 2e-3)]
        difference = (4 * steps[0] - steps[1]) / 3
        worst = max(worst, float(jnp.abs(program(x)[1] - difference).max() / jnp.abs(difference).max()))
    assert worst < 1e-7
    hard("second derivatives", "forward map, log conductivity", float64=worst, beyond="finite and symmetric")


@pytest.mark.slow
def test_contacts_know_how_they_hang_on_a_frame_of_nothing(model):
    """No touch, a frame of zeros, gaps, nothing at all: no contact, and a derivative of zero, not of NaN."""
    finder = je.prepare_contacts(model, noise=np.full(550, 1e-5), most=1, columns=11)

    def numbers(dv):
        found = finder(dv)
        return jnp.sum(found.position) + jnp.sum(found.width) + jnp.sum(found.strength) + jnp.sum(found.covariance)

    program = jax.jit(lambda dv: (numbers(dv), jax.grad(numbers)(dv)))
    nothing = jnp.zeros(550)
    for dv in (nothing, nothing.at[7].set(jnp.nan), jnp.full(550, jnp.nan), nothing.at[7].set(jnp.inf)):
        value, slope = program(dv)
        assert float(value) == 0
        assert not np.asarray(slope).any()


# --- twice the same ----------------------------------------------------------------------------------------------


def _everything() -> str:
    """Fields, Jacobian, image and map of one small skin, as one number."""
    model = square_model(POINTS, je.adjacent(6), SIDE)
    basis = je.Pixels(SIDE).on(model)
    dv = je.forward(model, 1.3 * model.background) - je.forward(model)
    recon = je.prepare(model, basis=basis)
    masks = je.PadMasks(jnp.ones((1, PIXELS)), basis.areas)
    sparse = je.prepare(model, je.Noser(), je.SparseBayes(), basis)
    found = dv, je.jacobian(model, basis=basis), recon.matrix, sparse(dv), je.fuse(recon(dv), masks, jnp.ones(1)).force
    return hashlib.sha256(b"".join(np.asarray(a).tobytes() for a in found)).hexdigest()


@pytest.mark.slow
def test_every_bit_is_the_same_twice_and_in_another_process(root):
    """On one machine; another one may order its sums otherwise."""
    program = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "from tests import test_hard_gradients as t; print(t._everything())"
    )
    there = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True)
    assert _everything() == _everything() == there.stdout.strip()
