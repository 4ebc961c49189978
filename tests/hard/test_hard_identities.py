"""Identities as properties: of any sheet (conductivities over six decades, contacts over fifteen), mesh and recording.

One program serves all examples of a test: sheets and contacts are its arguments, and the ground is too.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxeit as je
from calib.presses import find_presses
from calib.session import SessionFacts, SessionWriter, StreamFacts, open_session
from calib.session.stream import LARGEST_VALUE
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..hard_sheet import MESH, paired, sheet_model
from ..hard_strip import PLACES as STRIP_PLACES, STRIP, Unchecked, strip_error
from ..helpers import require_identical, skin_of
from ..session.test_session import options

examples = settings(max_examples=25, deadline=None, derandomize=True, database=None)
seeds = st.integers(0, 2**32 - 1)
decades = st.floats(0, 3)
contacts = st.lists(st.floats(-9, 6), min_size=4, max_size=4).map(lambda powers: 10.0 ** np.array(powers))
MODEL = je.linalg.NestedDissection()


def _theta(seed, spread, resistances):
    sigma = 10.0 ** np.random.default_rng(seed).uniform(-spread, spread, len(MESH.triangles))
    return coefficients(sheet_model(MODEL), jnp.asarray(sigma))._replace(contact=1 / jnp.asarray(resistances))


def _z(theta):
    return np.asarray(transfer(sheet_model(MODEL), theta))


def _rounding(z):
    return 1e-9 * np.abs(paired(z)).max()


@examples
@given(seeds, decades, contacts)
def test_reciprocity(seed, spread, resistances):
    readings = paired(_z(_theta(seed, spread, resistances)))
    np.testing.assert_allclose(readings, readings.T, rtol=1e-9, atol=1e-12 * np.abs(readings).max())


@examples
@given(seeds, decades, contacts, st.integers(-60, 60))
def test_readings_scale_with_resistance(seed, spread, resistances, power):
    """U(c sigma, z / c) = U / c, and in powers of two to the last digit."""
    theta = _theta(seed, spread, resistances)
    scaled = jax.tree.map(lambda leaf: leaf * 2.0 ** (2 * power), theta)
    require_identical(2.0 ** (2 * power) * paired(_z(scaled)), paired(_z(theta)))


@examples
@given(seeds, decades, contacts, st.integers(0, 3), st.floats(1.01, 100))
def test_what_conducts_better_has_less_resistance(seed, spread, resistances, part, more):
    """For any currents that sum to zero, in the sense of Loewner; a quarter of the sheet, and each contact."""
    theta = _theta(seed, spread, resistances)
    before, quarter = _balanced(_z(theta)), np.arange(len(MESH.triangles)) % 4 == part
    for better in (
        theta._replace(sigma=jnp.where(quarter, more * theta.sigma, theta.sigma)),
        theta._replace(contact=theta.contact.at[part].multiply(more)),
    ):
        fall = np.linalg.eigvalsh(before - _balanced(_z(better)))
        assert fall[0] > -1e-9 * np.abs(before).max()
        assert fall[-1] > 0


def _balanced(z):
    """The quadratic form for currents that sum to zero."""
    into_last = np.concatenate([np.eye(len(z) - 1), -np.ones((1, len(z) - 1))])
    return into_last.T @ z @ into_last


@examples
@given(seeds, decades, contacts)
def test_sensitivities_sum_to_minus_the_voltage(seed, spread, resistances):
    """Euler: of sheet and contacts together, as readings are homogeneous of degree -1 in both."""
    theta = _theta(seed, spread, resistances)
    z, slope = _along_itself(sheet_model(MODEL), theta)
    np.testing.assert_allclose(
        paired(np.asarray(slope)), -paired(np.asarray(z)), rtol=1e-8, atol=_rounding(np.asarray(z))
    )


@eqx.filter_jit
def _along_itself(model, theta):
    return jax.jvp(lambda t: transfer(model, t), (theta,), (theta,))


@examples
@given(seeds, decades, contacts, st.integers(0, 29))
def test_the_ground_may_be_anywhere(seed, spread, resistances, which):
    model, theta = sheet_model(MODEL), _theta(seed, spread, resistances)
    ground = model.system.ground.at[:].set(model.system.ground[which])  # the same program
    there = eqx.tree_at(lambda m: m.system.ground, model, ground)
    z = _z(theta)
    np.testing.assert_allclose(paired(np.asarray(transfer(there, theta))), paired(z), rtol=1e-7, atol=_rounding(z))


SQUARE = je.Rectangle(1.0, 1.0)
CELLS = 4
PLACES = [(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)]  # a quarter turn takes each to the next


@pytest.fixture(scope="module")
def square():
    skin = skin_of(SQUARE, [je.PointElectrode(p) for p in PLACES], [[0, 1, 2, 3]])
    mesh = je.meshing.structured(SQUARE, CELLS, CELLS, pattern=je.meshing.TrianglePattern.CROSSED)
    return je.discretise(je.Scene(skin), je.Fidelity(solver=je.linalg.Dense()), mesh=mesh), mesh


def _moved(mesh, image):
    """The triangle that each one is moved to."""
    where = {tuple(p): k for k, p in enumerate(mesh.centroids.round(9))}
    return np.array([where[tuple(p)] for p in image(mesh.centroids).round(9)])


@examples
@given(seeds, decades, st.integers(0, 3), st.booleans())
def test_a_turned_or_mirrored_sheet_reads_the_same(square, seed, spread, turns, mirrored):
    model, mesh = square
    sigma = 10.0 ** np.random.default_rng(seed).uniform(-spread, spread, len(mesh.triangles))
    there, moved = np.arange(4), sigma
    for _ in range(turns):
        moved, there = _carried(mesh, moved, lambda p: np.stack([1 - p[:, 1], p[:, 0]], 1)), (there + 1) % 4
    if mirrored:
        moved, there = _carried(mesh, moved, lambda p: p[:, ::-1]), np.array([0, 3, 2, 1])[there]
    one, other = (np.asarray(transfer(model, coefficients(model, jnp.asarray(s)))) for s in (sigma, moved))
    np.testing.assert_allclose(paired(other[there][:, there]), paired(one), rtol=1e-9, atol=_rounding(one))


def _carried(mesh, sigma, image):
    out = np.empty_like(sigma)
    out[_moved(mesh, image)] = sigma
    return out


@settings(examples, max_examples=8)
@given(seeds, st.floats(0, 0.45))
def test_a_strip_reads_the_same_on_any_mesh(seed, much):
    """Nodes moved by up to so much of an edge, nodes and triangles in any order, triangles from any corner."""
    rng, mesh = np.random.default_rng(seed), je.meshing.structured(STRIP, 20, 10)
    x, y = mesh.nodes.T
    rim = (x == 0) | (x == STRIP.width) | (y == 0) | (y == STRIP.height)
    held = rim | (np.linalg.norm(mesh.nodes[:, None] - np.array(STRIP_PLACES), axis=-1) < 1e-9).any(1)
    moved = mesh.nodes + np.where(held[:, None], 0, 0.01 * much * rng.uniform(-0.5, 0.5, mesh.nodes.shape))
    order = rng.permutation(len(moved))
    triangles = np.argsort(order)[mesh.triangles[rng.permutation(len(mesh.triangles))]]
    assert strip_error(Unchecked(moved[order], np.roll(triangles, int(rng.integers(3)), 1))) < 1e-11


recordings = st.lists(st.floats(width=32), min_size=1, max_size=40)


@settings(examples, max_examples=15)
@given(recordings, st.integers(1, 40), st.integers(1, 40), st.integers(1, 10**12), seeds)
def test_any_recording_comes_back_however_it_is_cut(tmp_path_factory, values, written, read, gap, seed):
    """In any pieces; what is not finite, or larger than any sensor reads, is missing."""
    values = np.array(values, "f4")[:, None]
    time = np.cumsum(np.random.default_rng(seed).integers(1, gap + 1, len(values)))
    path = tmp_path_factory.mktemp("any") / "s.h5"
    with SessionWriter(path, SessionFacts(**options())) as writer:
        writer.add_stream("force", StreamFacts("force", units="N", channels=1, rate_hz=100))
        for i in range(0, len(values), written):
            writer.append("force", time[i : i + written], values[i : i + written])
    with open_session(path) as session:
        stream = session.streams["force"]
        np.testing.assert_array_equal(stream.time, time)
        found = np.concatenate([stream.read(i, i + read) for i in range(0, len(values), read)])
        np.testing.assert_array_equal(found, np.where(np.abs(values.astype(float)) <= LARGEST_VALUE, values, np.nan))


@examples
@given(seeds, st.integers(0, 6), st.floats(0, 0.3), st.integers(-40, 40), st.integers(-(2**61), 2**61))
def test_presses_are_where_they_are_in_any_unit_and_on_any_clock(seed, count, lost, power, later):
    """In order, one after the other; to the sample with forces times 2^k, and with clocks that started elsewhere."""
    rng = np.random.default_rng(seed)
    time = 20_000_000 * np.arange(1500) + rng.integers(0, 10_000_000, 1500)
    force = rng.normal(0, 0.05, 1500)
    for start in rng.uniform(1, 25, count):
        ramp = np.clip(np.minimum(time / 1e9 - start, start + 3 - time / 1e9) / 0.3, 0, 1)
        force += rng.uniform(1, 50) * ramp
    force[rng.uniform(size=1500) < lost] = np.nan
    found, other = find_presses(time, force), find_presses(time + later, 2.0**power * force)
    edges = np.stack([found.t_press, found.t_hold0, found.t_hold1, found.t_release], 1)
    assert (np.diff(edges.ravel()) >= 0).all()
    there = np.stack([other.t_press, other.t_hold0, other.t_hold1, other.t_release], 1)
    np.testing.assert_array_equal(there, edges + later)
    assert found.reason == other.reason


@pytest.mark.slow
@settings(max_examples=12, deadline=None, derandomize=True, database=None)
@given(seeds, st.booleans(), st.integers(4, 9), st.floats(0.05, 0.2), st.floats(1.2, 1.7), st.sampled_from([1, 2]))
def test_any_skin_and_protocol_keeps_the_identities(seed, askew, count, edge, growth, order):
    """Bolts at random places of a sheet of random proportions, readings between random electrodes.

    Of meshes that grow faster than by 1.7 a quarter is refused, as an angle is below 20 degrees.
    """
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.1, 0.4, 2)
    corners = [(0, 0), (1, 0.1), (0.9, 1), (0.1, 0.9)] * size
    sheet = je.Polygon([tuple(c) for c in corners.tolist()]) if askew else je.Rectangle(*size.tolist())
    grid = np.stack(np.meshgrid(*(np.arange(1, 4) / 4,) * 2), -1).reshape(-1, 2)[rng.permutation(9)[:count]]
    places = (grid + rng.uniform(-0.05, 0.05, grid.shape)) * size
    bolts = [je.AreaPatch(tuple(p), 0.003, 10.0 ** rng.uniform(-9, 0)) for p in places.tolist()]
    pattern = np.array([rng.permutation(count)[:4] for _ in range(10)])
    skin = skin_of(sheet, bolts, np.concatenate([pattern, pattern[:, [2, 3, 0, 1]]]), sheet_resistance=100.0)
    model = je.discretise(je.Scene(skin), je.Fidelity(edge_length=edge, growth=growth, order=order))
    sigma = model.background * jnp.asarray(10.0 ** rng.uniform(-1, 1, model.background.shape))
    readings = np.asarray(je.forward(model, sigma))
    np.testing.assert_allclose(readings[:10], readings[10:], rtol=1e-8, atol=1e-10 * np.abs(readings).max())
    theta = coefficients(model, sigma)
    z, slope = jax.jvp(partial(transfer, model), (theta,), (theta,))
    quarter, _ = jax.jvp(partial(transfer, model), (jax.tree.map(lambda x: 4 * x, theta),), (theta,))
    np.testing.assert_allclose(slope, -z, atol=1e-9 * np.abs(z).max())
    np.testing.assert_allclose(4 * quarter, z, rtol=1e-12, atol=1e-12 * np.abs(z).max())
