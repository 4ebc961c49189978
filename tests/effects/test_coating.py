"""The continuous metal coat: two coupled sheets against exact solutions, a dense assembly and identities."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.meshing.elements import function_space
from jaxeit.model.forward_model import fields, transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..helpers import require_identical, sheet_of, skin_of

COAT = (je.effects.ContinuousCoating(),)
SQUARE = je.Rectangle(0.2, 0.2)
POINTS = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.10)]


def _block(x, y, size, contact):
    corners = [(x, y), (x + size, y), (x + size, y + size), (x, y + size)]
    return je.PolygonPatch(je.Polygon(corners), contact)


def _skin():
    """One electrode of each kind, on lines of a mesh of 8 cells a side."""
    bolts = [_block(0.125, 0.05, 0.025, 1e-3), _block(0.05, 0.15, 0.025, 0.0)]
    rim, point = je.BoundaryPatch(0.05, 0.1, 0.02), je.PointElectrode((0.15, 0.15))
    return skin_of(SQUARE, [rim, *bolts, point], [[0, 1, 2, 3], [0, 1, 0, 1], [2, 3, 0, 1], [0, 2, 1, 2]])


@pytest.fixture(scope="module")
def mixed():
    """Sheet and metal on one mesh."""
    fidelity = je.Fidelity(solver=Dense())
    return je.discretise(je.Scene(_skin(), COAT), fidelity, mesh=je.meshing.structured(SQUARE, 8, 8))


def _apart(order):
    return je.discretise(je.Scene(_bolted(), COAT), je.Fidelity(edge_length=0.1, order=order, solver=Dense()))


@pytest.fixture(scope="module")
def apart():
    """The metal on its own mesh."""
    return _apart(1)


@pytest.fixture(scope="module")
def quadratic():
    return _apart(2)


def _bolted(sheet_resistance=1.0):
    bolts = [je.AreaPatch(p, 0.01, 1e-3) for p in POINTS]
    return skin_of(SQUARE, bolts, [[0, 1, 2, 3], [0, 1, 0, 1], [2, 3, 0, 1]], sheet_resistance=sheet_resistance)


def _touch(model, places=((0.1, 0.1),), width=0.02, strength=30.0):
    """Uneven conductivity, and Gaussian contacts beyond which nothing touches."""
    x, y = np.asarray(model.centroids).T
    square = np.min([(x - a) ** 2 + (y - b) ** 2 for a, b in places], 0)
    coupling = np.where(square < (2 * width) ** 2, strength * np.exp(-square / width**2), 0)
    return je.model.CoatedSheet(jnp.asarray(1 + x + 3 * y), jnp.asarray(20.0), jnp.asarray(coupling))


def _by_hand(skin, mesh, sheet):
    """Readings from the potentials of sheet, metal and electrodes as they stand: P1, nodal contact, least squares."""
    n = len(mesh.nodes)
    unknown = np.arange(2 * n + len(skin.electrodes))
    matrix = np.zeros((len(unknown),) * 2)

    def add(places, block):
        at = unknown[np.asarray(places)]
        np.add.at(matrix, np.ix_(at, at), block)

    space = function_space(mesh, 1)
    pieces = [electrode.pieces(space, skin.domain) for electrode in skin.electrodes]
    for number, (electrode, piece) in enumerate(zip(skin.electrodes, pieces, strict=True)):
        if electrode.contact == 0:
            unknown[piece.dofs] = 2 * n + number
        else:
            for dofs, mass in zip(piece.dofs, piece.mass / electrode.contact, strict=True):
                total = mass.sum(1, keepdims=True)
                add([*dofs, 2 * n + number], np.block([[mass, -total], [-total.T, total.sum()]]))
    corners, areas = mesh.nodes[mesh.triangles], mesh.areas
    opposite = np.roll(corners, -1, 1) - np.roll(corners, -2, 1)
    stiffness = opposite @ opposite.transpose(0, 2, 1) / (4 * areas[:, None, None])
    sigma, metal, coupling = (np.asarray(value) for value in sheet)
    for e, triangle in enumerate(mesh.triangles):
        add(triangle, sigma[e] * stiffness[e])
        add(n + triangle, metal * stiffness[e])
        for node in triangle:
            add([node, n + node], coupling[e] * areas[e] / 3 * np.array([[1, -1], [-1, 1]]))
    a, b, c, d = 2 * n + skin.protocol.pattern.T
    z = np.linalg.pinv(matrix, rcond=1e-13, hermitian=True)
    return z[c, a] - z[d, a] - z[c, b] + z[d, b]


def test_sheet_and_metal_agree_with_a_dense_assembly(mixed):
    """Every kind of electrode, pressed beside, across and upon them."""
    mesh = je.meshing.structured(SQUARE, 8, 8)
    for places in ([(0.1, 0.1)], [(0.14, 0.06), (0.05, 0.17)], [(0.07, 0.0), (0.15, 0.15)]):
        sheet = _touch(mixed, places)
        np.testing.assert_allclose(je.forward(mixed, sheet), _by_hand(_skin(), mesh, sheet), rtol=1e-10)


def _strip(cells, order=1):
    """0.2 m long, between perfect electrodes on its ends."""
    width = 0.2 / cells
    ends = [je.BoundaryPatch(s, s + width, 0.0) for s in (0.2, 0.4 + width)]
    strip = je.Rectangle(0.2, width)
    skin = skin_of(strip, ends, [[0, 1, 0, 1]])
    return je.discretise(
        je.Scene(skin, COAT), je.Fidelity(order=order, solver=Dense()), mesh=je.meshing.structured(strip, cells, 1)
    )


def _strip_error(cells, order, sigma, metal, coupling):
    """With both sheets in parallel but for what passes the contact: L / W (s1 + s2) and, at each end, the hump of
    ``u - m``, which decays with ``k^2 = g (1 / s1 + 1 / s2)``."""
    model = _strip(cells, order)
    ones = jnp.ones_like(model.background)
    found = je.forward(model, je.model.CoatedSheet(sigma * ones, jnp.asarray(metal), coupling * ones))[0]
    k = np.sqrt(coupling * (1 / sigma + 1 / metal))
    hump = 2 * metal / (sigma * k) * np.tanh(k * 0.1)
    return float(found) / ((0.2 + hump) / (sigma + metal) * cells / 0.2) - 1


@pytest.mark.parametrize("coupling", [0.1, 100.0, 3000.0])
@pytest.mark.parametrize("metal", [0.3, 20.0])
def test_a_strip_has_the_closed_form(metal, coupling):
    coarse, fine = (_strip_error(cells, 1, 0.7, metal, coupling) for cells in (20, 40))
    assert abs(fine) < 0.02
    assert np.log2(coarse / fine) == pytest.approx(2, abs=0.3)
    assert abs(_strip_error(20, 2, 0.7, metal, coupling)) < abs(fine)


@pytest.fixture(scope="module")
def testbed(skin):
    return je.discretise(je.Scene(skin, (je.effects.LoadSpreading(), *COAT)), je.Fidelity.draft())


def test_nothing_touching_leaves_the_bare_sheet(model, testbed):
    """To rounding, with the solver that users have; and without pressure the metal is not even asked."""
    resting = je.conductivity(testbed, jnp.zeros_like(testbed.background))
    bare = np.asarray(je.forward(model))
    np.testing.assert_allclose(je.forward(testbed, resting), bare, atol=1e-12 * np.abs(bare).max())
    np.testing.assert_array_equal(je.conductivity(testbed), testbed.background)


def test_a_perfect_contact_makes_one_sheet(mixed):
    """Of both conductivities; what is missing falls with the contact's resistance."""
    sigma, metal = _touch(mixed).sigma, jnp.asarray(20.0)
    one = np.asarray(je.forward(mixed, sigma + metal))
    errors = []
    for coupling in (1e7, 1e9):
        sheet = je.model.CoatedSheet(sigma, metal, jnp.full_like(sigma, coupling))
        errors.append(np.abs(np.asarray(je.forward(mixed, sheet)) / one - 1).max())
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(100, rel=0.1)


def test_a_light_touch_finds_the_metal_floating(quadratic):
    """``dZ = -sum G (x_a - c_a)(x_b - c_b)``, c being the mean of x under the contact: the metal takes no current."""
    touch, strength = _touch(quadratic, strength=1.0), 1e-9
    x = fields(quadratic, coefficients(quadratic, touch.sigma))
    conductance = _contact(quadratic, touch.coupling)
    away = np.asarray(x.potential) - conductance @ np.asarray(x.potential) / conductance.sum()
    expected = -strength * np.einsum("n,na,nb->ab", conductance, away, away)
    theta = coefficients(quadratic, touch._replace(coupling=strength * touch.coupling))
    _, slope = jax.jvp(lambda t: transfer(quadratic, t), (theta,), (_only(theta, coupling=theta.coat.coupling),))
    np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def _contact(model, coupling):
    """Conductance from each unknown of P2 to the metal, through the midpoints of edges."""
    dofs = np.asarray(model.system.dofs)[:, -3:]
    share = np.repeat(np.asarray(coupling * model.areas)[:, None] / 3, 3, 1)
    return np.bincount(dofs.ravel(), share.ravel(), model.system.unknowns)


def _only(theta, **coat):
    zero = jax.tree.map(jnp.zeros_like, theta)
    return zero._replace(coat=zero.coat._replace(**coat))


def test_however_light_a_touch_it_never_breaks(apart):
    bare, touch = np.asarray(je.forward(apart, _touch(apart).sigma)), _touch(apart, strength=1.0)
    for strength in (1e-300, 1e-100, 1e-30, 1e-15):
        found = np.asarray(je.forward(apart, touch._replace(coupling=strength * touch.coupling)))
        np.testing.assert_allclose(found, bare, atol=1e-12 * np.abs(bare).max())


def test_identities(quadratic):
    """Reciprocity; Z is homogeneous of degree -1 in all conductances; more contact never raises a resistance."""
    theta = coefficients(quadratic, _touch(quadratic))
    x = fields(quadratic, theta)
    z = np.asarray(x.terminal)
    np.testing.assert_allclose(z, z.T, rtol=1e-10)
    np.testing.assert_allclose(z, transfer(quadratic, theta), rtol=1e-10)
    _, slope = jax.jvp(lambda t: transfer(quadratic, t), (theta,), (theta,))
    np.testing.assert_allclose(slope, -z, rtol=1e-9)
    more = theta._replace(coat=theta.coat._replace(coupling=theta.coat.coupling + 1.0))
    centred = np.eye(4) - 0.25
    fall = centred @ (z - np.asarray(transfer(quadratic, more))) @ centred
    assert np.linalg.eigvalsh(fall)[1:].min() > 1e-6 * np.abs(z).max()


def test_derivatives(apart):
    """Forwards and backwards, to pressure and the effect's own parameters, against differences."""
    spread = jnp.exp(-jnp.sum((apart.centroids - 0.1) ** 2, 1) / 0.03**2)

    @jax.jit
    def reading(parameters):
        load, resistance, sigma = parameters
        effect = je.effects.ContinuousCoating(resistance=resistance, contact_resistivity=0.1)
        coated = effect(sheet_of(apart.background * sigma, apart.centroids, load * spread))
        return je.forward(apart, je.model.CoatedSheet(coated.sigma, coated.metal, coated.coupling))[0]

    at, step = jnp.array([64e3, 0.1, 1.3]), 1e-3
    slopes = jax.jit(lambda at, along: jax.jvp(reading, (at,), (along,)))
    gradient = jax.jit(jax.grad(reading))
    for k in range(3):
        along = jnp.zeros(3).at[k].set(at[k])
        _, slope = slopes(at, along)
        assert float(gradient(at) @ along) == pytest.approx(float(slope), rel=1e-9)
        difference = (reading(at + step * along) - reading(at - step * along)) / (2 * step)
        assert float(slope) == pytest.approx(float(difference), rel=1e-5)
    assert np.isfinite(np.asarray(gradient(jnp.array([0.0, 0.1, 1.3])))).all()


def test_readings_do_not_depend_on_the_ground():
    mesh, scene = je.meshing.structured(SQUARE, 8, 8), je.Scene(_skin(), COAT)
    first, second = (je.discretise(scene, je.Fidelity(solver=Dense()), mesh=mesh, ground=g) for g in (0, 40))
    np.testing.assert_allclose(je.forward(first, _touch(first)), je.forward(second, _touch(first)), rtol=1e-10)


def test_the_effect_follows_the_power_law_and_the_protrusions():
    pressure = jnp.array([0.0, 64e3, 32e3])
    sheet = sheet_of(jnp.ones(3), jnp.zeros((3, 2)), pressure)
    coated = je.effects.ContinuousCoating(exponent=0.5)(sheet)
    np.testing.assert_allclose(coated.coupling * 1.6e-5 * 3, [0, 1, 0.5**0.5], rtol=1e-12)
    assert float(coated.metal) == pytest.approx(10.0)
    slope = jax.grad(lambda p: je.effects.ContinuousCoating(exponent=0.5)(sheet._replace(pressure=p)).coupling.sum())(
        pressure
    )
    assert np.isfinite(np.asarray(slope)).all()
    cut = sheet._replace(share=jnp.full(3, 0.25), pressure=4 * pressure)  # the load of four cells on one
    np.testing.assert_allclose(
        je.effects.ContinuousCoating()(cut).coupling, je.effects.ContinuousCoating()(sheet).coupling, rtol=1e-12
    )


def test_two_contacts_talk_through_the_metal(model, testbed):
    """The changes of two touches, 9 cm apart, do not add; under the local law they all but do."""
    one, two = (5.0 * je.model.load_spread(testbed, jnp.array(place), 0.02) for place in ([0.07, 0.11], [0.14, 0.06]))

    def interaction(law):
        dv = [np.asarray(law(p) - je.forward(model)) for p in (one, two, one + two)]
        return np.linalg.norm(dv[2] - dv[0] - dv[1]) / np.linalg.norm(dv[2])

    def local(p):
        sheet = sheet_of(model.background, model.centroids, p)
        return je.forward(model, je.effects.ContactPiezoresistance()(sheet).sigma)

    assert interaction(local) < 0.02
    assert interaction(lambda p: je.forward(testbed, je.conductivity(testbed, p))) > 0.3


def _pressed(model):
    """The change of the readings by a touch."""
    pressure = 64e3 * jnp.exp(-jnp.sum((model.centroids - 0.1) ** 2, 1) / 0.02**2)
    return np.asarray(je.forward(model, je.conductivity(model, pressure)) - je.forward(model))


@pytest.mark.slow
def test_a_coarser_metal_costs_little():
    """The mesh of the metal, which `discretise` makes coarser, against one as fine as the sheet's."""
    scene, fidelity = je.Scene(_bolted(150.0), COAT), je.Fidelity(edge_length=0.07, solver=Dense())
    coarse, fine = (
        je.discretise(scene, fidelity),
        je.discretise(scene, fidelity, mesh=je.model.make_mesh(scene, fidelity)),
    )
    assert coarse.coat.plan.n < 0.8 * fine.coat.plan.n
    np.testing.assert_allclose(_pressed(coarse), _pressed(fine), rtol=1e-3)


def test_a_coat_over_a_bent_sheet():
    """Rolled up without stretching, sheet and metal are the flat ones."""
    fidelity, skin = je.Fidelity(edge_length=0.07, solver=Dense()), _bolted()
    rolled = replace(skin, surface=je.Cylinder(0.3))
    flat, bent = (je.discretise(je.Scene(s, COAT), fidelity) for s in (skin, rolled))
    np.testing.assert_allclose(_pressed(bent), _pressed(flat), rtol=5e-3)


def test_jit_vmap_and_single_precision(apart):
    batch = jax.vmap(lambda strength: _touch(apart, strength=1.0)._replace(coupling=strength * _touch(apart).coupling))
    sheets = batch(jnp.array([0.0, 0.5, 1.0]))
    together = jax.jit(jax.vmap(lambda *s: je.forward(apart, je.model.CoatedSheet(*s))))(*sheets)
    for k, row in enumerate(together):
        alone = je.forward(apart, jax.tree.map(lambda leaf, k=k: leaf[k], sheets))
        np.testing.assert_allclose(row, alone, rtol=1e-10)
    single = je.discretise(je.Scene(_bolted(), COAT), je.Fidelity(edge_length=0.1, dtype=np.float32, solver=Dense()))
    double = je.discretise(je.Scene(_bolted(), COAT), je.Fidelity(edge_length=0.1, solver=Dense()))
    low = je.forward(single, jax.tree.map(lambda leaf: leaf.astype(np.float32), _touch(double)))
    np.testing.assert_allclose(low, je.forward(double, _touch(double)), rtol=2e-4)


def test_what_does_not_fit_is_refused(model, apart):
    sheet = _touch(apart)
    with pytest.raises(ValueError, match="no metal coat"):
        je.forward(model, sheet)
    with pytest.raises(ValueError, match=r"coupling is float64\[3\]"):
        je.forward(apart, sheet._replace(coupling=jnp.ones(3)))
    with pytest.raises(ValueError, match="sigma is"):
        je.forward(apart, jnp.ones(3))


def test_the_jacobian_is_that_of_the_untouched_sheet():
    bare, coated = (
        je.discretise(je.Scene(_bolted(), effects), je.Fidelity(edge_length=0.1, solver=Dense()))
        for effects in ((), COAT)
    )
    require_identical(je.jacobian(coated), je.jacobian(bare))
