"""The forward model against exact solutions and identities."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..helpers import skin_of, square_model
from ..oracles.disc import disc_resistance
from ..oracles.rectangle import four_point

POINTS = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.13)]


@pytest.mark.parametrize("sigma", ["x", object(), [[1.0], [1.0, 2.0]]])
def test_what_is_no_conductivity_is_refused(model, sigma):
    with pytest.raises(ValueError, match=r"^sigma is .*; give an array of real numbers$"):
        je.forward(model, sigma)
    with pytest.raises(ValueError, match=r"^sigma is .*; give the conductivity of each element, S, as an array$"):
        je.prepare(model, basis=je.Pixels(4), sigma=sigma)


def test_rectangle_oracle_has_the_published_value():
    exact = four_point(0.2, 0.2, (0.06, 0.06), (0.14, 0.10), (0.10, 0.142), (0.062, 0.13))
    assert exact == pytest.approx(-0.1409373898, abs=1e-10)


@pytest.mark.parametrize(("order", "bound"), [(1, 2e-4), (2, 6e-5)])
def test_point_electrodes_on_the_square(order, bound):
    model = square_model(POINTS, [[0, 1, 2, 3]], 20, order=order)
    exact = four_point(0.2, 0.2, *POINTS)
    assert float(je.forward(model)[0]) == pytest.approx(exact, rel=bound)


def test_van_der_pauw():
    """Contacts at the corners of a square: R = R_s ln 2 / pi, here with R_s = 1 and 1 A."""
    corners = [(0.0, 0.0), (0.2, 0.0), (0.2, 0.2), (0.0, 0.2)]
    errors = []
    for cells in (10, 20):
        model = square_model(corners, [[0, 1, 3, 2]], cells, order=2, solver=Dense())
        errors.append(float(je.forward(model)[0]) / (np.log(2) / np.pi) - 1)
    assert abs(errors[1]) < 4e-4
    assert abs(errors[1]) < abs(errors[0]) / 3


def _patched(contact):
    """Bolts at four places of the square, sensed apart from the drive."""
    bolts = [je.AreaPatch(p, 0.006, contact) for p in POINTS]
    skin = skin_of(je.Rectangle(0.2, 0.2), bolts, [[0, 1, 2, 3], [0, 1, 0, 1]])
    return je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.06, solver=Dense()))


def test_four_terminal_readings_do_not_feel_the_contact():
    """They tend to the perfect contact at one end and to a limit of even injection at the other."""
    perfect, tiny = (np.asarray(je.forward(_patched(c))) for c in (0.0, 1e-12))
    assert tiny[0] == pytest.approx(perfect[0], rel=1e-9)
    assert tiny[1] - perfect[1] == pytest.approx(2 * disc_resistance(0.006, 1e-12, 1.0), rel=1e-3)
    large, larger = (np.asarray(je.forward(_patched(c)))[0] for c in (1e2, 1e8))
    assert large == pytest.approx(larger, rel=1e-6)


DRAFT = je.Fidelity(edge_length=0.06, growth=1.6, solver=Dense())


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", [je.Fidelity.draft(edge_length=0.1), je.Fidelity.draft(edge_length=0.1, order=2)])
def test_a_contact_that_four_terminal_readings_feel_is_resolved(fidelity):
    """Transfer length 0.8 mm, triangles of 2.9 mm: the error is that of the mesh with perfect contacts, and less than
    what the closed form leaves out."""
    places = [(0.06, 0.06), (0.1, 0.06), (0.1, 0.1), (0.06, 0.1), (0.08, 0.14), (0.14, 0.08)]

    def read(contact, fidelity):
        bolts = [je.AreaPatch(place, 0.003, contact) for place in places]
        skin = skin_of(je.Rectangle(0.2, 0.2), bolts, je.skin.adjacent(6), sheet_resistance=150.0)
        model = je.discretise(je.Scene(skin), fidelity)
        assert not np.asarray(model.system.lumped).any()
        return np.asarray(je.forward(model))

    fine = je.Fidelity(edge_length=0.05, order=2, electrode_segments=64)
    poor, perfect = (read(contact, fine) for contact in (1e-4, 0.0))
    felt = np.linalg.norm(poor - perfect) / np.linalg.norm(perfect)
    error = [np.linalg.norm(read(c, fidelity) - v) / np.linalg.norm(v) for c, v in ((1e-4, poor), (0.0, perfect))]
    assert error[0] < 1.1 * error[1]
    assert error[0] < 0.7 * felt


WEIGHTS = [[3, 1, 4, 1], [5, 9, 2, 6], [5, 3, 5, 8], [9, 7, 9, 3]]


def _mixed_skin():
    """One electrode of each kind: on the rim, a resolved bolt, one in closed form, a point."""
    rim, point = je.BoundaryPatch(0.09, 0.11, 0.02), je.PointElectrode((0.05, 0.06))
    bolts = [je.AreaPatch((0.14, 0.10), 0.012, 1e-3), je.AreaPatch((0.10, 0.16), 0.008, 1e-8)]
    return skin_of(
        je.Rectangle(0.2, 0.2), [rim, *bolts, point], [[0, 1, 2, 3], [0, 1, 0, 1], [2, 3, 2, 3], [0, 2, 1, 2]]
    )


@pytest.fixture(scope="module")
def mixed():
    model = je.discretise(je.Scene(_mixed_skin()), DRAFT)
    assert (np.asarray(model.system.lumped) > 0).tolist() == [False, False, True, False]
    return model


def _uneven(model):
    return model.background * (1 + 0.5 * jax.random.uniform(jax.random.key(1), model.areas.shape))


def test_scaling_of_conductivity_and_contact():
    """U(c sigma, z / c) = U / c."""
    model = _patched(1e-4)
    theta = coefficients(model, model.background)
    scaled = theta._replace(sigma=3 * theta.sigma, contact=3 * theta.contact)
    np.testing.assert_allclose(3 * transfer(model, scaled), transfer(model, theta), rtol=1e-11)


def test_numbers_of_the_system_have_the_precision_of_the_model(model):
    """Also those of the electrodes of a skin none of which has an area of its own."""
    assert model.system.measure.dtype == model.dtype
    assert not np.any(model.system.measure)


def test_reciprocity(model, skin):
    voltages = np.asarray(je.forward(model))
    partner = je.skin.reciprocal_rows(skin.protocol.pattern)
    assert (partner >= 0).all()
    np.testing.assert_allclose(voltages, voltages[partner], atol=1e-14)


def test_readings_do_not_depend_on_the_ground(mixed):
    mesh = je.model.make_mesh(je.Scene(_mixed_skin()), DRAFT)
    for node in (0, len(mesh.nodes) // 2):
        other = je.discretise(je.Scene(_mixed_skin()), DRAFT, mesh=mesh, ground=node)
        np.testing.assert_allclose(je.forward(other), je.forward(mixed), rtol=1e-11)


def test_more_conductivity_means_less_resistance(mixed):
    """Of the drive at any pattern of currents, not only at pairs: the matrix falls in the sense of Loewner,
    whether a sheet's part or a contact conducts better."""
    theta = coefficients(mixed, _uneven(mixed))
    bump = jnp.where(mixed.centroids[:, 0] < 0.07, 0.2 * theta.sigma, 0.0)
    before = _balanced(transfer(mixed, theta))
    for more in (theta._replace(sigma=theta.sigma + bump), theta._replace(contact=1.3 * theta.contact)):
        fall = np.linalg.eigvalsh(before - _balanced(transfer(mixed, more)))
        assert fall[0] > -1e-12
        assert fall[-1] > 1e-3


def _balanced(z):
    """The quadratic form for currents that sum to zero."""
    into_last = np.concatenate([np.eye(len(z) - 1), -np.ones((1, len(z) - 1))])
    return into_last.T @ np.asarray(z) @ into_last


def test_sensitivities_and_contact_terms_sum_to_minus_the_voltage(mixed):
    """Euler: readings are homogeneous of degree -1 in the conductances of sheet and contacts together."""
    sigma = _uneven(mixed)
    theta = coefficients(mixed, sigma)
    _, slope = jax.jvp(lambda t: transfer(mixed, t), (theta,), (theta,))
    z = np.asarray(transfer(mixed, theta))
    np.testing.assert_allclose(slope, -z, atol=1e-12 * np.abs(z).max())
    sheet = np.asarray(je.jacobian(mixed, sigma) @ sigma)
    contact = np.asarray(_contact_slope(mixed, theta))
    np.testing.assert_allclose(sheet + contact, -je.forward(mixed, sigma), rtol=1e-10)
    assert np.abs(contact).max() > 0.1 * np.abs(sheet).max()


def _contact_slope(model, theta):
    along = theta._replace(sigma=jnp.zeros_like(theta.sigma))
    _, slope = jax.jvp(lambda t: transfer(model, t), (theta,), (along,))
    a, b, c, d = np.asarray(model.pattern).T
    return slope[c, a] - slope[d, a] - slope[c, b] + slope[d, b]


def test_derivatives_with_every_kind_of_electrode(mixed):
    """Jacobian, forward and reverse mode and central differences agree, in the sheet and in the contacts."""
    sigma = _uneven(mixed)
    theta, found = coefficients(mixed, sigma), np.asarray(je.jacobian(mixed, sigma))
    weights = np.array([3.0, 1.0, -4.0, 2.0])
    reverse = jax.grad(lambda s: weights @ je.forward(mixed, s))(sigma)
    np.testing.assert_allclose(weights @ found, reverse, atol=1e-12 * np.abs(found).max())
    direction = sigma * jnp.sin(jnp.arange(sigma.size))
    _, along = jax.jvp(lambda s: je.forward(mixed, s), (sigma,), (direction,))
    np.testing.assert_allclose(found @ direction, along, rtol=1e-9)
    high, low = (np.asarray(je.forward(mixed, sigma + h * direction)) for h in (1e-5, -1e-5))
    np.testing.assert_allclose(found @ direction, (high - low) / 2e-5, rtol=1e-7)

    turn = np.array([1.0, -0.5, 2.0, 0.0])  # of the contacts; the point has none

    def weighed(contact):
        return jnp.sum(jnp.asarray(WEIGHTS, float) * transfer(mixed, theta._replace(contact=contact)))

    slope = float(jax.grad(weighed)(theta.contact) @ (theta.contact * turn))
    high, low = (float(weighed(theta.contact * (1 + h * turn))) for h in (1e-5, -1e-5))
    assert slope == pytest.approx((high - low) / 2e-5, rel=1e-7)


def test_symmetry_of_the_grid_of_electrodes():
    """A mirror in the diagonal and a quarter turn of the 5 x 5 grid permute the readings."""
    square = je.Rectangle(0.2, 0.2)
    grid = [(0.02 + 0.04 * i, 0.02 + 0.04 * j) for j in range(5) for i in range(5)]
    mirrored = [5 * (k % 5) + k // 5 for k in range(25)]
    turned = [5 * (k % 5) + 4 - k // 5 for k in range(25)]
    pattern = [[0, 1, 7, 13], [2, 18, 6, 24]]
    moved = [[[there[e] for e in row] for row in pattern] for there in (mirrored, turned)]
    skin = skin_of(square, [je.PointElectrode(p) for p in grid], pattern + moved[0] + moved[1])
    mesh = je.meshing.structured(square, 20, 20, pattern=je.meshing.TrianglePattern.CROSSED)
    voltages = np.asarray(je.forward(je.discretise(je.Scene(skin), je.Fidelity(solver=Dense()), mesh=mesh)))
    np.testing.assert_allclose(voltages[2:4], voltages[:2], rtol=1e-11)
    np.testing.assert_allclose(voltages[4:], voltages[:2], rtol=1e-11)


def test_a_bent_sheet_reads_as_the_flat_one():
    """Bending without stretching changes no voltage: exact for a fold along mesh lines."""
    square = je.Rectangle(0.2, 0.2)
    skin = skin_of(square, [je.PointElectrode(p) for p in POINTS], [[0, 1, 2, 3]])
    mesh = je.meshing.structured(square, 20, 20)
    radius = 0.1

    def cylinder(chart):
        x, y = chart.T
        return np.stack([radius * np.sin(x / radius), y, radius * np.cos(x / radius)], 1)

    flat, bent = (
        float(je.forward(je.discretise(je.Scene(skin), je.Fidelity(solver=Dense()), mesh=m))[0])
        for m in (mesh, mesh.lift(cylinder))
    )
    assert bent == pytest.approx(flat, rel=1e-3)  # chords are (h / r)^2 / 24 shorter than arcs


def test_jit_vmap_and_grad_of_forward():
    model = square_model(POINTS, [[0, 1, 2, 3], [0, 2, 1, 3]], 20)
    sigma = model.background
    batch = jnp.stack([sigma, 2 * sigma])
    together = jax.vmap(lambda s: je.forward(model, s))(batch)
    alone = jnp.stack([je.forward(model, s) for s in batch])
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    np.testing.assert_allclose(eqx.filter_jit(je.forward)(model, sigma), alone[0], rtol=1e-12)
    # voltages are homogeneous of degree -1 in the conductivity (Euler)
    slope = jax.grad(lambda s: je.forward(model, s)[0])(sigma)
    assert float(slope @ sigma) == pytest.approx(-float(alone[0, 0]), rel=1e-10)


def test_a_batch_of_no_conductivities_gives_no_readings(model):
    none = jnp.zeros((0, len(model.background)))
    assert jax.vmap(partial(je.forward, model))(none).shape == (0, model.readings)
    assert jax.vmap(partial(je.jacobian, model))(none).shape == (0, model.readings, len(model.background))


def test_float32_follows_float64():
    single, double = (
        np.asarray(je.forward(square_model(POINTS, [[0, 1, 2, 3]], 20, dtype=d))) for d in ("float32", "float64")
    )
    assert single.dtype == np.float32
    assert single[0] == pytest.approx(double[0], rel=1e-4)


def test_wrong_sigma_is_refused(model):
    with pytest.raises(ValueError, match="one value per element"):
        je.forward(model, jnp.ones(3))
    with pytest.raises(ValueError, match=r"float32.*; use \.astype\(model\.dtype\)"):
        je.forward(model, model.background.astype(jnp.float32))
    with pytest.raises(ValueError, match=r"; use jax\.vmap for a batch"):
        je.forward(model, jnp.stack([model.background] * 2))
    short = eqx.tree_at(lambda m: m.background, model, model.background[:3])
    with pytest.raises(ValueError, match=r"^background is float64\[3\]; this model needs float64\[\d+\]"):
        je.forward(short)
    with pytest.raises(ValueError, match=r"^sigma is .*one value per element"):
        je.forward(short, short.background)


def test_float64_without_x64_is_refused(skin):
    with jax.enable_x64(False), pytest.raises(je.model.FidelityError, match="jax_enable_x64"):
        je.discretise(je.Scene(skin), je.Fidelity.draft())


@pytest.mark.parametrize("call", [je.forward, je.jacobian, je.prepare])
def test_a_model_of_float64_is_refused_without_x64(model, call):
    said = "^the model is of float64, but JAX is in 32-bit mode; before making any array call jax.config.update"
    with jax.enable_x64(False), pytest.raises(je.model.FidelityError, match=said):
        call(model)


def test_electrodes_on_one_node_are_refused():
    points = [(0.06, 0.06), (0.06, 0.06), (0.1, 0.1), (0.14, 0.1)]
    with pytest.raises(je.skin.ElectrodeError, match="electrodes 0 and 1"):
        square_model(points, [[0, 1, 2, 3]], 20)


def _bolts_apart(contact, segments, order):
    """Two bolts far apart on a sheet of 100 ohm per square, driven and sensed at two terminals."""
    bolts = [je.AreaPatch((x, 0.1), 0.003, contact) for x in (0.05, 0.15)]
    skin = skin_of(je.Rectangle(0.2, 0.2), bolts, [[0, 1, 0, 1]], sheet_resistance=100.0)
    fidelity = je.Fidelity(edge_length=0.1, order=order, electrode_segments=segments, growth=1.6)
    return je.discretise(je.Scene(skin), fidelity)


@pytest.mark.slow
def test_a_resolved_bolt_has_the_resistance_of_the_closed_form():
    """Transfer length 0.55 mm, triangles of 0.4 mm: the area integral is resolved."""
    contact = 3e-5
    resolved, perfect = (_bolts_apart(c, 48, 2) for c in (contact, 0.0))
    assert not np.asarray(resolved.system.lumped).any()
    found = float(je.forward(resolved)[0] - je.forward(perfect)[0]) / 2
    assert found == pytest.approx(disc_resistance(0.003, contact, 100.0), rel=0.02)


def test_a_bolt_that_the_mesh_does_not_resolve_takes_the_closed_form():
    lumped, perfect = (_bolts_apart(c, 12, 1) for c in (1e-6, 0.0))
    assert np.asarray(lumped.system.lumped).all()
    found = float(je.forward(lumped)[0] - je.forward(perfect)[0]) / 2
    assert found == pytest.approx(disc_resistance(0.003, 1e-6, 100.0), rel=1e-9)
    # its derivative, by three ways
    sigma = lumped.background * (1 + 0.3 * jnp.sin(jnp.arange(lumped.background.size)))
    adjoint = je.jacobian(lumped, sigma)[0]
    np.testing.assert_allclose(adjoint, jax.grad(lambda s: je.forward(lumped, s)[0])(sigma), rtol=1e-9, atol=1e-9)
    step = 1e-5 * sigma
    difference = (je.forward(lumped, sigma + step) - je.forward(lumped, sigma - step))[0] / 2
    assert float(adjoint @ step) == pytest.approx(float(difference), rel=1e-6)


def test_disc_resistance_of_the_physics_note():
    assert disc_resistance(3e-3, 1e-6, 100.0) == pytest.approx(0.54, abs=0.005)
