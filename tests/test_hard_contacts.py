"""Contacts from perfect to none: no digit may be lost, which only exact arithmetic can tell."""

from fractions import Fraction
from functools import cache
from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.electrodes import PolygonPatch
from jaxeit.forward import coefficients, transfer

from .helpers import skin_of
from .oracles.rational import transfer_matrix

SHEET = je.Rectangle(8.0, 4.0)
EDGES = {0: (0.0, 1.0), 1: (13.0, 15.0)}  # arc lengths: under the sheet near a corner, over its middle
PATCHES = {2: (1.0, 2.0, 2.0, 3.0), 3: (5.0, 1.0, 7.0, 2.0)}  # corners of rectangles in it
EVEN = [(10.0**k,) * 4 for k in (-12, -9, -6, -3, 0, 3, 6)]
MIXED = [(1e-12, 1e6, 1e-12, 1e6), (1e6, 1e-12, 1e-6, 1.0), (1e-12, 1e-12, 1e6, 1e6)]
PAIRS = list(combinations(range(4), 2))


def _sigma(mesh):
    return np.random.default_rng(0).integers(1, 33, len(mesh.triangles)) / 16.0


@cache
def _model(solver):
    electrodes = [je.BoundaryPatch(*EDGES[k], 1.0) for k in (0, 1)]
    for k in (2, 3):
        x0, y0, x1, y1 = PATCHES[k]
        electrodes.append(PolygonPatch(je.Polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), 1.0))
    skin = skin_of(SHEET, electrodes, [[0, 1, 2, 3]])
    return je.discretise(je.Scene(skin), je.Fidelity(solver=solver), mesh=je.structured(SHEET, 8, 4))


@cache
def _exact(contacts):
    """Readings for every pair that drives and every pair that senses."""
    mesh, pieces = je.structured(SHEET, 8, 4), []
    for k, (start, stop) in EDGES.items():
        along = SHEET.boundary_coordinate(mesh.nodes[mesh.boundary_edges].mean(1))
        under = mesh.boundary_edges[(start < along) & (along < stop)]
        pieces += [(edge.tolist(), k, 1 / Fraction(contacts[k])) for edge in under]
    for k, (x0, y0, x1, y1) in PATCHES.items():
        x, y = mesh.centroids.T
        under = mesh.triangles[(x0 < x) & (x < x1) & (y0 < y) & (y < y1)]
        pieces += [(triangle.tolist(), k, 1 / Fraction(contacts[k])) for triangle in under]
    return _pairs(transfer_matrix(mesh.nodes, mesh.triangles.tolist(), _sigma(mesh), pieces, 4)).astype(float)


def _pairs(z):
    return np.array([[z[c, a] - z[d, a] - z[c, b] + z[d, b] for c, d in PAIRS] for a, b in PAIRS])


@pytest.mark.parametrize("contacts", EVEN + MIXED, ids=str)
@pytest.mark.parametrize("solver", [je.Dense(), je.NestedDissection()], ids=["dense", "dissection"])
def test_no_digit_is_lost_to_the_contacts(contacts, solver):
    """Drive, three-terminal and four-terminal readings in double precision against exact arithmetic."""
    model = _model(solver)
    theta = coefficients(model, jnp.asarray(_sigma(je.structured(SHEET, 8, 4))))
    z = np.asarray(transfer(model, theta._replace(contact=1 / jnp.asarray(contacts))))
    np.testing.assert_allclose(_pairs(z), _exact(contacts), rtol=1e-12)


def test_a_disc_of_any_contact_follows_its_limits():
    """I0(x) / I1(x) = 2 / x + x / 4 - x^3 / 96 for weak contacts, 1 + 1 / 2x + 3 / 8x^2 for strong ones."""
    radius, sheet = 0.003, 100.0
    for contact in 10.0 ** np.arange(2, 7):
        weak = contact / (np.pi * radius**2) + sheet / (8 * np.pi) * (1 - sheet * radius**2 / contact / 24)
        assert je.disc_resistance(radius, contact, sheet) == pytest.approx(weak, rel=1e-14)
    for contact in 10.0 ** np.arange(-18, -11):
        shorter = np.sqrt(contact / sheet) / radius
        strong = sheet / (2 * np.pi) * (shorter + shorter**2 / 2 + 3 * shorter**3 / 8)
        assert je.disc_resistance(radius, contact, sheet) == pytest.approx(strong, rel=1e-12)
