"""The disc with the complete electrode model: the semi-analytic solution, and finite elements against it."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.meshing.outlines import DiscFootprint, polygon_radius
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..helpers import skin_of
from ..oracles.disc import disc_potentials

SHOWN = [0, 2, 8]
GOLDEN = {  # (z, conductivity of the inclusion of radius 1/2): potentials of electrodes 0, 2 and 8
    (10, 1): (51.6185019, -0.2197156, -0.0061858),
    (1, 1): (5.7807020, -0.2192019, -0.0061849),
    (0.1, 1): (1.1881339, -0.2156918, -0.0061783),
    (0.01, 1): (0.705300, -0.208999, -0.006163),
    (0.001, 1): (0.6441, -0.2065, -0.00616),
    (0.1, 2): (1.1817891, -0.1996226, -0.0038618),
    (0.1, 1e6): (1.1707565, -0.1720916, -0.0004739),
    (0.1, 1e-6): (1.2123886, -0.2785202, -0.0174209),
}
SIDES = 32  # of the polygon that stands for the inclusion on the coarsest mesh
STARTS = 2 * np.pi * np.arange(16) / 16 - np.pi / 32


@cache
def _oracle(z, sigma1=1, degree=12):
    return disc_potentials(z, sigma1=sigma1, rho=0.0 if sigma1 == 1 else 0.5, degree=degree)


@pytest.mark.parametrize(("z", "sigma1"), GOLDEN)
def test_oracle_has_the_published_values(z, sigma1):
    """To their digits; the last row to 7e-5, and that needs a higher degree."""
    potentials = _oracle(z, sigma1, degree=12 if z > 0.001 else 24)[SHOWN]
    np.testing.assert_allclose(potentials, GOLDEN[z, sigma1], atol={0.01: 1e-5, 0.001: 7e-5}.get(z, 3e-7))


def test_oracle_converges_with_the_degree():
    """The current crowds at the ends of an electrode, the more the better its contact: at z = 0.1 twelve
    polynomials give 1e-7; at z = 0.001 they give 3e-4, and twice as many 1e-5."""
    drive = [_oracle(0.001, degree=degree)[0] for degree in (6, 12, 24)]
    assert (np.abs(np.diff(drive)) < (3e-3, 3e-4)).all()
    assert abs(_oracle(0.1, degree=6)[0] - _oracle(0.1)[0]) < 1e-5


def _patches():
    return [je.BoundaryPatch(float(s), float(s) + np.pi / 16, 0.1) for s in STARTS % (2 * np.pi)]


@cache
def _mesh(level):
    """Graded to the ends of the electrodes, with edges along the inclusion; each level halves every edge."""
    if level == 0:
        footprints = [*(p.footprint(0) for p in _patches()), DiscFootprint((0.0, 0.0), 0.5, SIDES)]
        return je.meshing.triangulate(je.Disc(1.0), footprints, 0.15, electrode_edge=0.025, growth=1.6)
    sides = SIDES * 2 ** (level - 1)
    fine, ring = _mesh(level - 1).refine(), polygon_radius(0.5, sides)
    radius = np.linalg.norm(fine.nodes, axis=1)
    target = radius.copy()
    target[np.unique(fine.boundary_edges)] = 1.0
    on_ring = np.isclose(radius, ring, rtol=1e-9) | np.isclose(radius, ring * np.cos(np.pi / sides), rtol=1e-9)
    target[on_ring] = polygon_radius(0.5, 2 * sides)
    return je.meshing.Mesh(fine.nodes * (target / np.maximum(radius, 1e-9))[:, None], fine.triangles)


@cache
def _model(level, order):
    skin = skin_of(je.Disc(1.0), _patches(), [[0, 1, 0, 1]])
    solver = Dense() if level + order < 3 else None
    return je.discretise(je.Scene(skin), je.Fidelity(order=order, solver=solver), mesh=_mesh(level))


@cache
def _potentials(level, order, z, sigma1=1):
    """Of all electrodes, summing to zero, for 1 A from electrode 0 to electrode 1."""
    model = _model(level, order)
    sigma = jnp.where(jnp.linalg.norm(model.centroids, axis=1) < 0.5, float(sigma1), 1.0)
    theta = coefficients(model, sigma)._replace(contact=jnp.full(16, 1 / z))
    columns = np.asarray(transfer(model, theta))
    potentials = columns[:, 0] - columns[:, 1]
    return potentials - potentials.mean()


def test_the_mesh_follows_the_inclusion():
    for level in (0, 1):
        mesh = _mesh(level).check(25)
        inside = np.linalg.norm(mesh.centroids, axis=1) < 0.5
        assert mesh.areas[inside].sum() == pytest.approx(np.pi / 4, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "z", "rate"),
    [
        *[(1, 1, 1.75), (1, 0.1, 1.7), (1, 0.01, 1.55), (1, 0.001, 1.3)],
        *[(2, 1, 2.5), (2, 0.1, 2.2), (2, 0.01, 1.8), (2, 0.001, 1.3)],
    ],
)
def test_rate_of_the_electrode_model(order, z, rate):
    """Of the drive voltage, from 375 to 1369 nodes.  At the end of an electrode the current density jumps and the
    field is r log r, which allows order 2 in the limit of fine meshes; but where the length z / R_s is shorter
    than the edges it looks like that of a perfect contact, sqrt(r), which allows order 1."""
    exact = _oracle(z, degree=12 if z > 0.001 else 24)[0]
    coarse, fine = (abs(_potentials(level, order, z)[0] - exact) for level in (0, 1))
    assert np.log2(coarse / fine) > rate - 0.05


@pytest.mark.parametrize(
    ("z", "drive", "sense"),
    [(10, 5e-5, 1e-4), (1, 1e-4, 1e-4), (0.1, 6e-4, 1e-4), (0.01, 3e-3, 3e-4), (0.001, 9e-3, 2e-3)],
)
def test_all_electrodes_on_the_disc(z, drive, sense):
    """Quadratic elements: relative error of the two driven electrodes (3e-5 is that of their length, chords for
    arcs), and of the others, as potentials against electrode 8, relative to the largest."""
    _compare(_potentials(1, 2, z), _oracle(z, degree=12 if z > 0.001 else 24), drive, sense)


def test_weak_contacts_inject_evenly():
    """At z = 1e6 the current density is even, which is the oracle at degree one with its z moved."""
    exact = disc_potentials(1.0, degree=1)
    exact[:2] += np.array([1, -1]) * (1e6 - 1) * 16 / np.pi
    _compare(_potentials(1, 2, 1e6), exact, 5e-5, 1e-4)


def _compare(found, exact, drive, sense):
    assert np.abs(found / exact - 1)[:2].max() < drive
    apart = (found - found[8]) - (exact - exact[8])
    assert np.abs(apart[2:]).max() < sense * np.abs(exact - exact[8])[2:].max()


@pytest.mark.parametrize(("sigma1", "eighth"), [(2, 1e-3), (1e6, 1e-2), (1e-6, 5e-4)])
def test_inclusion_rows(sigma1, eighth):
    """The published values by finite elements on a mesh along the inclusion, at contrasts of 2, 1e6 and 1e-6.
    The farthest electrode reads 1 / 2500 of the drive behind a conducting inclusion: right to one per cent."""
    exact = np.array(GOLDEN[0.1, sigma1])
    coarse, fine = (_potentials(level, 2, 0.1, sigma1)[SHOWN] / exact - 1 for level in (0, 1))
    assert (np.abs(fine) < [5e-4, 1e-4, eighth]).all()
    assert (np.log2(np.abs(coarse / fine))[[0, 2]] > 1.9).all()
