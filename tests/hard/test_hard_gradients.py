"""Derivatives of every public verb: right where it is smooth, finite at its kinks, the same however it is called.

A verb that is new must be listed: with a case, or with the reason why it has no derivative.
"""

import hashlib
import subprocess
import sys
from collections.abc import Callable
from functools import cache, partial
from inspect import isclass
from types import ModuleType, SimpleNamespace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.model import DerivativeError

from ..helpers import products, skin_of, spread_stacks, square_model

HIGHEST = jax.lax.Precision.HIGHEST

_DESCRIBES = "describes hardware, or reads or writes files: on the host"
_GEOMETRY = "geometry, on the host: its arrays are constants of a model"
_PREPARES = "decides by looking at values, on the host, and says so under jit; what it returns has derivatives"
_INNER = "a part of the verbs above, in their cases, or in the tests of its own room"
HOST = {
    "adjacent": _DESCRIBES,
    "all_pairs": _DESCRIBES,
    "bind": "what it is given has",
    "bind_many": "what it is given has",
    "compile_tracker": _PREPARES,
    "compiler_options": _DESCRIBES,
    "design_scan": _PREPARES,
    "move_electrodes": _PREPARES,
    "discretise": _GEOMETRY,
    "drives": _DESCRIBES,
    "eidors_adjacent": _DESCRIBES,
    "electrode_motion": _PREPARES,
    "expected_mesh_nodes": _GEOMETRY,
    "few_choices": _PREPARES,
    "find_misplacement": _PREPARES,
    "fit_depth": _PREPARES,
    "fit_electrodes": _PREPARES,
    "fit_model_error": _PREPARES,
    "is_covariance": "says yes or no",
    "parse_values": "reads a text",
    "fidelity_choices": _PREPARES,
    "LoadFitter": "compares kinds of loads of one frame, on the host, and says so under jit",
    "learn_loads": _PREPARES,
    "prepare_loads": _PREPARES,
    "load_proposal": _DESCRIBES,
    "shipped_proposal": _DESCRIBES,
    "skin_hash": _DESCRIBES,
    "Proposal": "a network in NumPy, on the host",
    "prepare_tracker": _PREPARES,
    "press_evidence": "counts the evaluations of a search on the host, and says so under jit",
    "find_regions": "counts the regions of an image, on the host, and says so under jit",
    "flat_mesh": _GEOMETRY,
    "from_numbers": _DESCRIBES,
    "image_choices": _PREPARES,
    "ktc_score": "labels are integers; structural_similarity has the derivative",
    "ladder": _PREPARES,
    "load_reconstructor": _DESCRIBES,
    "load_skin": _DESCRIBES,
    "make_mesh": _GEOMETRY,
    "named_pattern": _DESCRIBES,
    "named_protocol": _DESCRIBES,
    "noise_covariance": _PREPARES,
    "opposite": _DESCRIBES,
    **dict.fromkeys(("half_height_classes", "on_grid", "segment"), "finds regions, on the host, and says so under jit"),
    "absolute_image": "an image with errors that grow, on the host, and says so under jit",
    "pad_masks": "geometry, on the host, and says so under jit",
    "pad_response": _GEOMETRY,
    "pad_overlap": _DESCRIBES,
    "parse_skin": _DESCRIBES,
    "parse_toml": _DESCRIBES,
    "place_sensitivity": _PREPARES,
    "prepare_contacts": _PREPARES,
    "prepare_event_scan": _PREPARES,
    "read_effects": _DESCRIBES,
    "read_mesh": _DESCRIBES,
    "read_text": _DESCRIBES,
    "reciprocal_rows": _DESCRIBES,
    "rim_electrodes": _DESCRIBES,
    "refine_contacts": _PREPARES,
    "require_dtype": _DESCRIBES,
    "cache_programs": _DESCRIBES,
    "limit_blas_threads": _DESCRIBES,
    "reuse_memory": _DESCRIBES,
    "rounding": "what it estimates has no direction",
    "save_reconstructor": _DESCRIBES,
    "scan_time": _DESCRIBES,
    "write_mesh": _DESCRIBES,
    **dict.fromkeys(("show_contacts", "show_current", "show_image", "show_mesh"), "draws a picture"),
    **dict.fromkeys(("show_sensitivity", "show_skin"), "draws a picture"),
    "shipped_skins": _DESCRIBES,
    "shortened": _DESCRIBES,
    "skip": _DESCRIBES,
    "structured": _GEOMETRY,
    "to_numbers": _DESCRIBES,
    "triangulate": _GEOMETRY,
    "undominated": "compares rows of a table, on the host",
    "trigonometric": _DESCRIBES,
    "AbstractSurface": _GEOMETRY,
    "Cylinder": _GEOMETRY,
    "Plane": _GEOMETRY,
    "Sphere": _GEOMETRY,
    "with_positions": _DESCRIBES,
    "with_rows": _DESCRIBES,
    "verb": "a decorator",
    "AbstractEstimator": "an abstract base of cases",
    "AbstractReconstructor": "an abstract base of cases",
    **dict.fromkeys(
        [
            "chosen",
            "require_limits",
            "default_solver",
            "from_words",
            "function_space",
            "laid",
            "limited",
            "settings_of",
            "split_word",
        ],
        _DESCRIBES,
    ),
    **dict.fromkeys(["computed", "fold", "history", "history_start", "keys", "parameter"], _INNER),
    **dict.fromkeys(["inverse_columns", "matvec", "normal_equations", "quadratic", "solve_spd"], _INNER),
    **dict.fromkeys(["eigh", "solve", "svd"], _INNER),
}


class Case(NamedTuple):
    """A verb as a function of one vector; smooth points, where the derivative is checked, and kinks."""

    function: Callable
    smooth: list
    kinks: list


POINTS = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15), (0.1, 0.1), (0.1, 0.0)]
SIDE = 4
PIXELS = SIDE**2


def _tiny(dtype):
    """Six electrodes, 32 triangles, 16 pixels; and the same with a pad between the tip and the sheet."""
    felt = (je.effects.LoadSpreading(), je.effects.ContactPiezoresistance())
    model, pressed = (
        square_model(POINTS, je.skin.adjacent(6), SIDE, dtype=dtype, effects=effects) for effects in ((), felt)
    )
    rng = np.random.default_rng(0)
    return SimpleNamespace(
        model=model,
        pressed=pressed,
        basis=je.Pixels(SIDE).on(model),
        rng=rng,
        dtype=dtype,
        draw=lambda n: jnp.asarray(rng.normal(size=n), dtype),
    )


@pytest.fixture(scope="module")
def tiny():
    return _tiny("float64")


@pytest.fixture(scope="module")
def single():
    return _tiny("float32")


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
        return je.model.load_spread(t.pressed, x[:2], x[2])

    return Case(pressure, [jnp.array([0.07, 0.12, 0.02])], [jnp.append(t.model.centroids[9], 0.02)])


def _jacobian(t):
    even = t.model.background
    return Case(lambda s: je.jacobian(t.model, s, t.basis), [even, even * jnp.exp(t.draw(32))], [])


def _moved(t):
    motion = je.model.electrode_motion(t.model)
    return Case(
        lambda x: je.forward(je.model.moved(t.model, motion, x.reshape(-1, 2))), [1e-3 * t.draw(12)], [jnp.zeros(12)]
    )


def _shift_jacobian(t):
    motion, even = je.model.electrode_motion(t.model), t.model.background
    return Case(lambda s: je.model.shift_jacobian(t.model, motion, s), [even, even * jnp.exp(t.draw(32))], [])


def _reference(t):
    """Conductivity and gains from a frame; the electrodes of the model are points, without contacts."""
    settings = je.imaging.ReferenceSettings(contact=0, contact_each=0, gain=0.01)
    frame = je.forward(t.model)

    def fitted(change):
        value = je.imaging.fit_reference(t.model, frame * (1 + 0.01 * change), settings).value
        return jnp.append(value.gain, value.level)

    return Case(fitted, [t.draw(len(frame))], [])


def _fuse(t):
    half = (jnp.arange(PIXELS) < PIXELS // 2).astype(t.dtype)
    masks = je.fusion.PadMasks(jnp.stack([half, 1 - half]), t.basis.areas)
    image = jnp.abs(t.draw(PIXELS))

    def force(x):
        return je.fuse(x[:PIXELS], masks, x[PIXELS:]).force

    def at(image, *forces):
        return jnp.append(image, jnp.array(forces, image.dtype))

    nothing = jnp.zeros(PIXELS)
    kinks = [at(nothing, 3, 2), at(nothing, 0, 0), at(image, 0, -1), at(-image, 3, 2), at(image, jnp.nan, 2)]
    return Case(force, [at(image, 3, 2)], [*kinks, at(image.at[3].set(jnp.nan), 3, 2)])


def _contact_shares(t):
    """Of two contacts on two pads; alike, on a corner of a pixel, absent, of no width."""
    half = (jnp.arange(PIXELS) < PIXELS // 2).astype(t.dtype)
    masks = je.fusion.PadMasks(jnp.stack([half, 1 - half]), t.basis.areas)

    def shares(x):
        found = je.fusion.contact_shares(x[:4].reshape(2, 2), x[4:6], x[6:], t.basis.centres, masks)
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


def _prepared(t, *how, **settings):
    """A reconstructor as a function of something that it is prepared from: an image, and the variance it states."""
    recon = je.prepare(t.model, *how, basis=t.basis, **settings)
    dv = jnp.cos(jnp.arange(recon.readings))
    return jnp.append(recon(dv), 1e-2 * recon.variance)


def _standard_deviations(t):
    return jnp.exp(0.3 * t.draw(t.model.pattern.shape[0]))


def _covariance(t):
    """Of correlated noise, as one vector."""
    spread = t.draw(t.model.pattern.shape[0] ** 2).reshape(2 * [t.model.pattern.shape[0]])
    return (spread @ spread.T / len(spread) + jnp.eye(len(spread), dtype=t.dtype)).ravel()


def _by_covariance(t):
    def image(x):
        square = x.reshape(2 * [t.model.pattern.shape[0]])
        return _prepared(t, noise=0.5 * (square + square.T))

    return Case(image, [_covariance(t)], [])


def _by_conductivity(*how):
    def case(t):
        even, std = t.model.background, _standard_deviations(t)
        return Case(lambda s: _prepared(t, *how, sigma=s, noise=std), [even * jnp.exp(0.1 * t.draw(32))], [])

    return case


def _by_noise(*how):
    return lambda t: Case(lambda std: _prepared(t, *how, noise=std), [_standard_deviations(t)], [])


def _by_hyperparameter(*how):
    def case(t):
        std = _standard_deviations(t)
        return Case(lambda h: _prepared(t, *how, noise=std, hyperparameter=h[0]), [jnp.array([0.1])], [])

    return case


LINEAR = {
    "one step, Laplace": (je.Laplace(), je.OneStep()),
    "one step, Gaussian": (je.GaussianSmooth(0.05, noser=True), je.OneStep()),
    "truncated": (je.Noser(), je.TruncatedSvd()),
    "back projection": (je.Noser(), je.imaging.BackProjection()),
    "GREIT": (je.Noser(), je.Greit(0.05, 0.06, 0.02)),
}


def _signal(t):
    """Of the noise and the hyperparameter."""

    def signal(x):
        return je.scan.signal_covariance(t.model, basis=t.basis, noise=x[:-1], hyperparameter=x[-1])

    return Case(signal, [jnp.append(_standard_deviations(t), 0.1)], [])


def _gains(t):
    signal = je.scan.signal_covariance(t.model, basis=t.basis)

    def gains(x):
        return je.scan.choose_readings(x[0] * signal, 5).gain

    return Case(gains, [jnp.ones(1)], [])


def _estimator(estimator):
    def case(t):
        image, same = t.draw(PIXELS), jnp.ones(PIXELS)
        return Case(lambda x: estimator(x, t.basis), [image], [0 * same, same, -same, image.at[3].set(jnp.nan)])

    return case


def _length(t):
    here, there = jnp.array([0.1, 0.2, 0.13, 0.16]), jnp.array([0.1, 0.2, 0.1, 0.2])
    return Case(lambda x: je.localisation_error(x[:2], x[2:]), [here], [there])


def _bias(t):
    centre = jnp.array([0.1, 0.1], t.dtype)
    kinks = [jnp.tile(centre, 2)]
    return Case(lambda x: je.metrics.inward_bias(x[:2], x[2:], centre), [jnp.array([0.11, 0.12, 0.13, 0.16])], kinks)


def _variation(t):
    values = jnp.abs(t.draw(5)) + 1
    return Case(lambda x: je.metrics.coefficient_of_variation(x, ddof=1), [values], [jnp.ones(5), jnp.zeros(5)])


def _greit(t):
    def figures(x):
        found = je.metrics.greit_figures(x, t.basis, jnp.array([0.1, 0.1]), jnp.array([0.1, 0.1]))
        return jnp.stack([found.amplitude, found.position_error, found.resolution, found.ringing])

    image, same = t.draw(PIXELS), jnp.ones(PIXELS)
    return Case(figures, [image], [0 * same, same, -same])


def _correlation(t):
    truth, same = t.draw(PIXELS), jnp.ones(PIXELS)
    return Case(
        lambda x: je.metrics.image_correlation(x, truth, t.basis.areas),
        [t.draw(PIXELS)],
        [0 * same, same, truth, 1e-3 * truth],
    )


def _similarity(t):
    truth, same = t.draw(PIXELS), jnp.ones(PIXELS)

    def like(x):
        return je.metrics.structural_similarity(x.reshape(SIDE, SIDE), truth.reshape(SIDE, SIDE), width=1.0)

    return Case(like, [t.draw(PIXELS)], [0 * same, same, truth])


def _otsu(t):
    values = t.draw(PIXELS)
    kinks = [jnp.zeros(PIXELS), jnp.ones(PIXELS), values.at[2].set(jnp.inf)]
    return Case(lambda x: je.metrics.otsu_thresholds(x, 3, bins=16), [values], kinks)


def _contacts(t):
    def place(x):
        fields = je.contacts.Contacts(
            x[:1] > 0, x[1:3][None], *[jnp.ones(1, t.dtype)] * 2, jnp.ones((1, 4, 4)), x[0], jnp.zeros(1, int)
        )
        return jnp.append(je.contacts.strongest(fields), fields.strength)

    return Case(place, [jnp.array([1.0, 0.1, 0.2])], [jnp.array([0.0, 0.1, 0.2])])


def _penalty(penalty):
    def case(t):
        return Case(
            lambda x: penalty.value(t.basis.picture, x), [t.draw(PIXELS)], [jnp.zeros(PIXELS), jnp.ones(PIXELS)]
        )

    return case


def _log_conductivity(t):
    physics = je.imaging.LogConductivity(t.model, t.basis, t.model.background[0])
    return Case(physics.voltages, [jnp.zeros(PIXELS), t.draw(PIXELS)], [])


CASES = {
    "forward": _forward,
    "conductivity": _conductivity,
    "load_spread": _load_spread,
    "jacobian": _jacobian,
    "moved": _moved,
    "shift_jacobian": _shift_jacobian,
    "fit_reference": _reference,
    "fuse": _fuse,
    "contact_shares": _contact_shares,
    "Reconstructor": _reconstructor,
    "IterativeReconstructor": lambda t: _reconstructor(t, je.Noser(), je.NonNegative()),
    "IterativeReconstructor, interior point": lambda t: _reconstructor(t, je.Laplace(), je.NonNegative(20)),
    "IterativeReconstructor, variation": lambda t: _reconstructor(t, je.TotalVariation(), je.Reweighted(3)),
    "IterativeReconstructor, sparse": lambda t: _reconstructor(t, je.Tikhonov(), je.SparseBayes(4)),
    "prepare, conductivity": _by_conductivity(),
    "prepare, noise": _by_noise(),
    "prepare, covariance of the noise": _by_covariance,
    "prepare, hyperparameter": _by_hyperparameter(),
    **{f"prepare, conductivity, {name}": _by_conductivity(*how) for name, how in LINEAR.items()},
    **{f"prepare, noise, {name}": _by_noise(*how) for name, how in LINEAR.items()},
    **{f"prepare, hyperparameter, {name}": _by_hyperparameter(*how) for name, how in LINEAR.items()},
    "signal_covariance": _signal,
    "choose_readings": _gains,
    "Peak": _estimator(je.metrics.Peak()),
    "LevelCentroid": _estimator(je.LevelCentroid()),
    "PositiveCentroid": _estimator(je.metrics.PositiveCentroid()),
    "localisation_error": _length,
    "inward_bias": _bias,
    "image_sum": lambda t: Case(
        lambda x: je.metrics.image_sum(x, t.basis.areas), [t.draw(PIXELS)], [jnp.zeros(PIXELS)]
    ),
    "coefficient_of_variation": _variation,
    "greit_figures": _greit,
    "image_correlation": _correlation,
    "structural_similarity": _similarity,
    "otsu_thresholds": _otsu,
    "strongest": _contacts,
    "around": lambda t: Case(
        lambda x: je.scan.around(t.basis, x, 0.02), [jnp.array([0.07, 0.12])], [t.basis.centres[3]]
    ),
    "in_frame": lambda t: Case(lambda x: je.scan.in_frame(x, jnp.array([1, 4]), 6), [t.draw(2)], [jnp.zeros(2)]),
    "IsotropicVariation": _penalty(je.imaging.IsotropicVariation()),
    "LogConductivity": _log_conductivity,
}
# Compiled by a dozen programs: seconds each.
SLOW = {
    name
    for name in CASES
    if name.startswith(
        ("Iterative", "Reconstructor", "jacobian", "Log", "conductivity", "prepare", "signal", "fit_reference")
    )
}
ELSEWHERE = {
    "ContactFinder": "below, and in tests/contacts/test_contacts.py",
    "fit_background": "in tests/imaging/test_background.py",
    "gauss_newton": "in tests/imaging/test_nonlinear.py",
    "gauss_newton_fit": "gauss_newton, whose image it is",
    "least_squares_image": "in tests/imaging/test_nonlinear.py",
}


def test_every_verb_is_listed():
    rooms = [je, *(room for name in je.__all__ if isinstance(room := getattr(je, name), ModuleType))]
    public = {name: getattr(room, name) for room in rooms for name in room.__all__}
    effects = {  # they have tests of their own
        name for name, thing in public.items() if isclass(thing) and issubclass(thing, je.effects.AbstractEffect)
    }
    verbs = {name for name, thing in public.items() if _is_called(thing)} - effects
    listed = {name.split(",")[0] for name in CASES} | set(HOST) | set(ELSEWHERE)
    assert not verbs - listed, "new: give it a case, or say why it has no derivative"
    assert listed <= set(public), "no longer public"


def _is_called(public):
    return any("__call__" in vars(c) for c in public.__mro__) if isclass(public) else callable(public)


def _program(case):
    """Value, derivative along a direction, and gradient, of a weighted sum of whatever is finite."""

    def numbers(x, along):
        def total(x):
            out = jnp.ravel(case.function(x))
            weight = jnp.cos(jnp.arange(1, out.size + 1, dtype=out.dtype))
            return jnp.sum(jnp.where(jnp.isfinite(out), out * weight, 0))

        value, slope = jax.jvp(total, (x,), (along,))
        return value, slope, jax.grad(total)(x)

    return numbers


def _marked(slow, names=tuple(CASES)):
    return [pytest.param(name, marks=pytest.mark.slow) if name in slow else name for name in names]


@pytest.fixture(scope="module")
def programs(tiny):
    """The case of a name and its compiled program, which two tests call: each is traced once."""

    def made(name):
        case = CASES[name](tiny)
        return case, jax.jit(_program(case))

    return cache(made)


# What methods have in common is tried with one of them.
OTHERS = {name for name in CASES if name.startswith("prepare") and name.endswith(tuple(LINEAR))}


@pytest.mark.parametrize("name", _marked(SLOW))
def test_derivatives_are_right_and_finite(hard, programs, name):
    case, program = programs(name)
    worst = 0.0
    for x in case.smooth:
        along = jnp.where(x == 0, 1, jnp.abs(x) * jnp.asarray(np.random.default_rng(1).normal(size=x.size)))
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


@pytest.mark.parametrize(
    "name", _marked(set(CASES) - {"fuse", "Peak", "coefficient_of_variation"}, [n for n in CASES if n not in OTHERS])
)
def test_jit_vmap_and_plain_python_agree(programs, name):
    case, compiled = programs(name)
    points = [*case.smooth, *case.kinks]
    along = jnp.ones_like(points[0])
    program = _program(case)
    batch = jax.jit(jax.vmap(program, (0, None)))(jnp.stack(points), along)
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
def test_float32_stays_float32(single, name):
    """Through every step, since a step in float64 would be refused where it meets float32: promotion is strict.

    And no product asks for less than full precision, by which a GPU would round its factors to ten bits.
    """
    case = CASES[name](single)
    x = case.smooth[0].astype("float32")
    program, found = jax.make_jaxpr(_program(case), return_shape=True)(x, x)
    for one in (jax.eval_shape(case.function, x), *found):
        assert one.dtype == "float32"
    assert all(product.params["precision"] == (HIGHEST, HIGHEST) for product in products(program.jaxpr))


@pytest.mark.parametrize("name", _marked(SLOW - {"prepare, conductivity"}))
def test_no_stack_of_matrices_is_spread_over_threads_that_wait_for_it(tiny, name):
    """However many are mapped at once; see `jaxeit.linalg.lapack`."""
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
    finder = je.prepare_contacts(model, je.contacts.ContactSettings(most=1, columns=11), noise=np.full(550, 1e-5))

    def numbers(dv):
        found = finder(dv)
        return jnp.sum(found.position) + jnp.sum(found.width) + jnp.sum(found.strength) + jnp.sum(found.covariance)

    program = jax.jit(lambda dv: (numbers(dv), jax.grad(numbers)(dv)))
    nothing = jnp.zeros(550)
    for dv in (nothing, nothing.at[7].set(jnp.nan), jnp.full(550, jnp.nan), nothing.at[7].set(jnp.inf)):
        value, slope = program(dv)
        assert float(value) == 0
        assert not np.asarray(slope).any()


# --- what has no derivative says so --------------------------------------------------------------------------------


def _leaves_of(model):
    """Name, place and value of each float leaf."""
    paths, structure = jax.tree_util.tree_flatten_with_path(model)
    values = [leaf for _, leaf in paths]

    def with_leaf(place, value):
        return jax.tree.unflatten(structure, [*values[:place], value, *values[place + 1 :]])

    floats = [k for k, leaf in enumerate(values) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return [(jax.tree_util.keystr(paths[k][0]), partial(with_leaf, k), values[k]) for k in floats]


@pytest.fixture(scope="module")
def complete():
    """Eight electrodes with a contact resistance, and a metal coat over the sheet."""
    starts = np.arange(8) * np.pi / 4
    patches = [je.BoundaryPatch(float(s), float(s + 0.3), 0.1) for s in starts]
    skin = skin_of(je.Disc(1.0), patches, [[0, 4, 2, 6], [1, 5, 3, 7]])
    scene = je.Scene(skin, (je.effects.ContinuousCoating(),))
    return je.discretise(scene, je.Fidelity(edge_length=0.2, solver=je.linalg.Dense()))


@pytest.mark.parametrize("which", ["tiny", pytest.param("complete", marks=pytest.mark.slow)])
def test_no_float_of_a_model_has_a_derivative_that_is_silently_zero(request, which):
    """Each has its own derivative, or an error that says why not."""
    model = request.getfixturevalue(which)
    model = model if which == "complete" else model.model
    pressed = 1e4 * jnp.ones_like(model.background)
    touched = partial(je.conductivity, pressure=pressed) if which == "complete" else je.conductivity
    parameters = {".background", ".contact", ".current"}
    for name, with_leaf, leaf in _leaves_of(model):

        def total(leaf, with_leaf=with_leaf):
            model = with_leaf(leaf)
            return jnp.sum(jnp.sin(1e3 * je.forward(model, touched(model))))

        if name in parameters and not (name == ".contact" and which == "tiny"):
            assert np.abs(jax.grad(total)(leaf)).max() > 0, name
        elif not name.startswith(".effects"):
            with pytest.raises(DerivativeError, match="contact" if name == ".contact" else "mesh"):
                jax.grad(total)(leaf)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd, lambda f: jax.jit(jax.grad(f))])
def test_the_mesh_has_no_derivative_however_it_is_asked_for(tiny, derivative):
    basis = je.Elements().on(tiny.model)
    for where in (lambda m: m.nodes, lambda m: m.system.slopes):
        for verb in (je.forward, partial(je.jacobian, basis=basis)):

            def total(leaf, verb=verb, where=where):
                return jnp.sum(verb(eqx.tree_at(where, tiny.model, leaf)))

            with pytest.raises(DerivativeError, match="mesh"):
                derivative(total)(where(tiny.model))


def test_what_decides_by_values_says_so_where_they_are_hidden(tiny):
    frame, flags = jnp.ones(18), np.ones(18, bool)
    model, basis = tiny.model, tiny.basis
    recon = je.prepare(model, basis=basis)
    skin = je.load_skin("testbed")
    hidden = {
        "channels": lambda x: je.prepare(model, basis=basis, channels=x > 0),
        "the protocol": lambda x: je.prepare(eqx.tree_at(lambda m: m.pattern, model, x), basis=basis),
        "NoiseFigure chooses": lambda x: je.prepare(model, basis=basis, noise=x, hyperparameter=je.NoiseFigure()),
        "prepare_contacts decides": lambda x: je.prepare_contacts(model, noise=x),
        "refine_contacts decides": lambda x: je.contacts.refine_contacts(model, x, None, noise=frame),
        "prepare_event_scan decides": lambda x: je.scan.prepare_event_scan(model, skin, je.scan.EventScanSettings(x)),
        "noise_covariance decides": lambda x: je.imaging.noise_covariance(jnp.stack([x] * 5)),
        "pad_masks decides": lambda x: je.pad_masks(skin, eqx.tree_at(lambda r: r.picture.areas, recon, x)),
        "find_regions decides": lambda x: je.contacts.find_regions(x, recon),
        "drives decides": lambda x: je.scan.choose_readings(jnp.eye(18), 3, pattern=x, switch=1.0),
        "on_host decides": lambda x: eqx.tree_at(lambda r: r.factor, recon, x).on_host(),
        "to_numbers decides": lambda x: je.imaging.to_numbers(eqx.tree_at(lambda r: r.factor, recon, x)),
    }
    for name, function in hidden.items():
        with pytest.raises(ValueError, match=f"{name}.* hides|hides {name}|hides the values of {name}"):
            jax.jit(function)(frame)
    fewer = jax.jit(lambda x: recon.without(x > 0)(frame))(jnp.where(flags, 0, 1).at[3].set(1))
    np.testing.assert_allclose(fewer, recon.without(np.arange(18) == 3)(frame), rtol=1e-9)


def test_a_reconstructor_made_under_jit_is_that_made_outside(tiny):
    """With its structure known, and a provenance that names what was hidden and retraces nothing."""
    seen, dv = [], jnp.cos(jnp.arange(18))

    @jax.jit
    def image(std, hyperparameter):
        recon = je.prepare(tiny.model, basis=je.Pixels(SIDE), noise=std, hyperparameter=hyperparameter)
        seen.append(recon)
        return recon(dv)

    for std, h in ((np.geomspace(1, 3, 18), 0.1), (np.ones(18), 0.2)):
        expected = je.prepare(tiny.model, basis=tiny.basis, noise=std, hyperparameter=h)(dv)
        np.testing.assert_allclose(image(std, h), expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
    assert len(seen) == 1
    assert seen[0].provenance["hyperparameter"] == seen[0].provenance["rank"] == "traced by JAX"
    assert seen[0].provenance["method"] == "OneStep()"
    assert np.asarray(seen[0].channels).all()
    assert not np.isfinite(image(np.full(18, np.nan), 0.1)).any()


# --- twice the same ----------------------------------------------------------------------------------------------


def _everything() -> str:
    """Fields, Jacobian, image and map of one small skin, as one number."""
    model = square_model(POINTS, je.skin.adjacent(6), SIDE)
    basis = je.Pixels(SIDE).on(model)
    dv = je.forward(model, 1.3 * model.background) - je.forward(model)
    recon = je.prepare(model, basis=basis)
    masks = je.fusion.PadMasks(jnp.ones((1, PIXELS)), basis.areas)
    sparse = je.prepare(model, je.Noser(), je.SparseBayes(), basis)
    found = dv, je.jacobian(model, basis=basis), recon.matrix, sparse(dv), je.fuse(recon(dv), masks, jnp.ones(1)).force
    return hashlib.sha256(b"".join(np.asarray(a).tobytes() for a in found)).hexdigest()


@pytest.mark.slow
def test_every_bit_is_the_same_twice_and_in_another_process(root):
    """On one machine; another one may order its sums otherwise."""
    program = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "from tests.hard import test_hard_gradients as t; print(t._everything())"
    )
    there = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True)
    assert _everything() == _everything() == there.stdout.strip()
