"""Electrodes that move: the model they leave, and derivatives by their places."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.model import MotionError, electrode_motion, moved, shift_jacobian

from ..helpers import disc_model, skin_of, square_model
from ..oracles.rectangle import four_point

POINTS = [(0.05, 0.05), (0.15, 0.05), (0.125, 0.15), (0.05, 0.125)]


def _bolts(contact, *, order=1, surface=None, edge_length=0.12):
    """Four bolts of 8 mm, the first two of which are driven and read too: their contact counts."""
    bolts = [je.AreaPatch(p, 0.008, contact) for p in POINTS]
    skin = skin_of(je.Rectangle(0.2, 0.2), bolts, [[0, 1, 2, 3], [0, 1, 0, 1], [1, 2, 0, 3]])
    fidelity = je.Fidelity(edge_length=edge_length, order=order, solver=Dense())
    return je.discretise(je.Scene(replace(skin, surface=surface)), fidelity)


MODELS = {
    "bolts with a contact in closed form": lambda: _bolts(1e-6),
    "complete bolts": lambda: _bolts(1e-2),
    "complete bolts of second order": lambda: _bolts(1e-2, order=2, edge_length=0.2),
    "bolts on a sphere": lambda: _bolts(1e-2, surface=je.Sphere(0.15, (0.1, 0.1))),
    "patches on the rim": lambda: disc_model(0.01, 0.2, electrodes=8, pattern=[[0, 1, 2, 3], [3, 4, 3, 4]]),
    "perfect patches": lambda: disc_model(0.0, 0.2, electrodes=8, pattern=[[0, 1, 2, 3], [1, 4, 5, 6]]),
}


QUICK = {"complete bolts", "bolts on a sphere", "perfect patches"}


@pytest.fixture(
    scope="module",
    params=[name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in MODELS],
)
def case(request):
    model = MODELS[request.param]()
    shift = np.random.default_rng(0).normal(size=(model.electrodes, 2))
    return model, electrode_motion(model), jnp.asarray(shift)


def test_a_model_whose_electrodes_stay_is_the_model(case):
    model, motion, shift = case
    still = jax.jit(moved)(model, motion, 0 * shift)
    for before, after in zip(jax.tree.leaves(model), jax.tree.leaves(still), strict=True):
        if jnp.issubdtype(before.dtype, jnp.floating) and before.size:
            np.testing.assert_allclose(after, before, rtol=0, atol=1e-12 * float(jnp.abs(before).max()))
    assert still.system.moved


def test_derivatives_are_those_of_the_moved_and_grown_readings(case):
    """Forward, reverse and by `shift_jacobian`, at electrodes that have moved and grown, against differences."""
    model, motion, direction = case
    reach = float(motion.reach.min())
    start = 0.05 * reach * direction, 0.03 * direction[:, 0]
    to_places, to_sizes = (direction, 0 * start[1]), (0 * direction, direction[:, 1])

    @jax.jit
    def readings(shift, growth):
        return je.forward(moved(model, motion, shift, growth))

    @jax.jit
    def both(shifts, growths):
        return jax.vmap(lambda *tangents: jax.jvp(readings, start, tangents))(shifts, growths)

    @jax.jit
    def weighted(shift, growth):
        return weight @ readings(shift, growth)

    values, forwards = both(*map(jnp.stack, zip(to_places, to_sizes, strict=True)))
    weight = jnp.arange(1.0, len(values[0]) + 1)
    backwards = jax.grad(weighted, (0, 1))(*start)
    for tangents, step, found in zip((to_places, to_sizes), (1e-6 * reach, 1e-5), forwards, strict=True):
        there, back = (
            readings(*(at + sign * step * tangent for at, tangent in zip(start, tangents, strict=True)))
            for sign in (1, -1)
        )
        expected = (there - back) / (2 * step)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * float(jnp.abs(expected).max()))
        slope = sum(jnp.sum(one * tangent) for one, tangent in zip(backwards, tangents, strict=True))
        np.testing.assert_allclose(slope, weight @ found, rtol=1e-9)
    slopes = shift_jacobian(jax.jit(moved)(model, motion, *start), motion)
    np.testing.assert_allclose(jnp.einsum("res,es->r", slopes, direction), forwards[0], rtol=1e-9, atol=1e-12)


def test_derivatives_are_those_of_greens_function():
    """Point electrodes in a rectangle, moved one by one: the closed form, but for the error of the mesh."""
    model = square_model(POINTS, [[0, 1, 2, 3], [0, 3, 1, 2]], 40)
    found = shift_jacobian(model, electrode_motion(model))

    def exact(points):
        points = points.reshape(4, 2)
        return np.array([four_point(0.2, 0.2, *points[row]) for row in ([0, 1, 2, 3], [0, 3, 1, 2])])

    points, step = np.array(POINTS).ravel(), 1e-4
    expected = np.stack([(exact(points + d) - exact(points - d)) / (2 * step) for d in step * np.eye(8)], 1)
    error = np.linalg.norm(np.asarray(found).reshape(2, 8) - expected) / np.linalg.norm(expected)
    assert error < 2e-3  # of the mesh; a sixteenth of it on 160 cells a side


@pytest.mark.slow
def test_a_bolt_that_moves_is_the_bolt_of_another_mesh(skin):
    """The derivative against skins whose bolt sits 2 mm aside, each on a mesh of its own."""
    fidelity = je.Fidelity(edge_length=0.06, order=2)

    def readings(aside):
        bolts = list(skin.electrodes)
        bolts[7] = replace(bolts[7], position=(bolts[7].position[0] + aside, bolts[7].position[1]))
        return je.discretise(je.Scene(replace(skin, electrodes=tuple(bolts))), fidelity)

    model = readings(0.0)
    expected = (je.forward(readings(2e-3)) - je.forward(readings(-2e-3))) / 4e-3
    found = shift_jacobian(model, electrode_motion(model))[:, 7, 0]
    assert float(jnp.linalg.norm(found - expected) / jnp.linalg.norm(expected)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("contact", [1e-6, 1e-3])
def test_a_bolt_that_grows_is_the_bolt_of_another_mesh(contact):
    """The derivative against bolts whose diameter is a twentieth more and less, each on a mesh of its own."""

    def readings(growth):
        bolts = [je.AreaPatch(p, 0.008 * (1 + growth * (k == 1)), contact) for k, p in enumerate(POINTS)]
        skin = skin_of(je.Rectangle(0.2, 0.2), bolts, [[0, 1, 2, 3], [0, 1, 0, 1], [1, 2, 0, 3]])
        return je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.04, order=2, solver=Dense()))

    model = readings(0.0)
    expected = (je.forward(readings(0.05)) - je.forward(readings(-0.05))) / 0.1
    motion, one = electrode_motion(model), jnp.zeros(4).at[1].set(1.0)
    found = jax.jvp(lambda growth: je.forward(moved(model, motion, growth=growth)), (0 * one,), (one,))[1]
    assert float(jnp.linalg.norm(found - expected) / jnp.linalg.norm(expected)) < 0.05


def test_a_disc_that_turns_reads_the_same():
    model = disc_model(0.01, 0.1, electrodes=8, pattern=je.skin.adjacent(8))
    slopes = shift_jacobian(model, electrode_motion(model))
    angle = 2 * np.pi * np.arange(8) / 8
    turn = jnp.stack([-jnp.sin(angle), jnp.cos(angle)], 1)
    one = jnp.einsum("res,es->re", slopes, turn)
    assert float(jnp.abs(one.sum(1)).max()) < 0.02 * float(jnp.abs(one).max())
    across = jnp.einsum("res,es->re", slopes, jnp.stack([jnp.cos(angle), jnp.sin(angle)], 1))
    assert float(jnp.abs(across).max()) < 1e-5 * float(jnp.abs(one).max())  # electrodes do not leave the rim


@pytest.mark.slow
def test_moved_models_have_jacobians_and_second_derivatives():
    model = square_model(POINTS, [[0, 1, 2, 3]], 8)
    motion, basis = electrode_motion(model), je.Elements().on(model)
    shift = jnp.asarray(np.random.default_rng(1).normal(size=(4, 2))) * 2e-3
    there = moved(model, motion, shift)
    expected = jax.jacfwd(lambda sigma: je.forward(there, sigma))(model.background)
    np.testing.assert_allclose(je.jacobian(there, basis=basis), expected, rtol=1e-8, atol=1e-12)

    def reading(shift):
        return je.forward(moved(model, motion, shift))[0]

    hessian = jax.hessian(reading)(shift)
    step = 1e-6 * jnp.ones((4, 2))
    expected = (jax.grad(reading)(shift + step) - jax.grad(reading)(shift - step)) / 2e-6
    np.testing.assert_allclose(hessian.sum((2, 3)), expected, rtol=1e-5, atol=1e-5 * float(jnp.abs(expected).max()))
    many = jax.vmap(reading)(jnp.stack([shift, 0 * shift]))
    np.testing.assert_allclose(many, [reading(shift), reading(0 * shift)], rtol=1e-12)


def test_what_cannot_be_moved_is_refused(skin):
    model = square_model(POINTS, [[0, 1, 2, 3]], 8)
    motion = electrode_motion(model)
    with pytest.raises(MotionError, match=r"shape \(2,\); give"):
        moved(model, motion, jnp.zeros(2))
    with pytest.raises(MotionError, match="another mesh"):
        moved(square_model(POINTS, [[0, 1, 2, 3]], 16), motion, jnp.zeros((4, 2)))
    with pytest.raises(MotionError, match=r"growth has shape \(2,\); give one number to each of 4"):
        moved(model, motion, growth=jnp.zeros(2))
    with pytest.raises(MotionError, match="electrode 3 is a point"):
        moved(model, motion, growth=jnp.zeros(4).at[3].set(0.1))
    far = jnp.zeros((4, 2)).at[2, 0].set(0.05)
    with pytest.raises(MotionError, match="electrode 2 moves 50 mm"):
        moved(model, motion, far)
    assert np.isnan(jax.jit(lambda shift: je.forward(moved(model, motion, shift)))(far)).all()
    with pytest.raises(MotionError, match="decides by looking at values"):
        jax.jit(lambda nodes: electrode_motion(replace(model, nodes=nodes)).reach)(model.nodes)
    with pytest.raises(MotionError, match="electrode 0 cannot be moved"):
        electrode_motion(disc_model(0.01, 0.2, electrodes=8, cover=0.9))
    coated = je.discretise(je.Scene(skin, (je.effects.ContinuousCoating(),)), je.Fidelity.draft())
    with pytest.raises(MotionError, match="metal coat"):
        electrode_motion(coated)


@pytest.mark.slow
def test_readings_of_any_currents_move_too():
    """Trigonometric currents: each reading is a sum over readings of four electrodes."""
    angle = 2 * np.pi * np.arange(8) / 8
    current = np.stack([np.cos(angle), np.sin(angle)], 1)
    protocol = je.Protocol.from_matrices(current, np.eye(8)[:, :-1] - np.eye(8)[:, 1:])
    patches = je.skin.rim_electrodes(je.Disc(1.0), 8, width=0.3, contact=0.01)
    model = je.discretise(
        je.Scene(je.Skin("tank", je.Disc(1.0), 1.0, patches, protocol)), je.Fidelity(edge_length=0.2, solver=Dense())
    )
    motion = electrode_motion(model)
    slopes = shift_jacobian(model, motion)
    expected = jax.jit(jax.jacfwd(lambda shift: je.forward(moved(model, motion, shift))))(jnp.zeros((8, 2)))
    assert slopes.shape == (14, 8, 2)
    np.testing.assert_allclose(slopes, expected, rtol=1e-9, atol=1e-12)
