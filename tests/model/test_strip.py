"""Electrodes across a strip, where the sheet's equation is one-dimensional and has an exact solution."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..helpers import skin_of
from ..oracles.strip import Patch, between_ends, between_two_patches, reading

LENGTH, SHEET = 0.2, 50.0
SPANS = [(0.0, 0.02), (0.05, 0.08), (0.11, 0.12), (0.16, 0.19)]  # the first at the end, the last short of it
UNEVEN = (0.01, 0.03, 0.002, 0.08)  # ohm m^2: transfer lengths of 6 to 40 mm
PATTERN = [[0, 3, 0, 3], [0, 3, 1, 2], [0, 2, 1, 3], [1, 2, 1, 2]]


def _patch(start, stop, width, contact):
    return je.PolygonPatch(je.Polygon([(start, 0.0), (stop, 0.0), (stop, width), (start, width)]), contact)


@cache
def _model(cells, order, contacts=UNEVEN):
    """One row of square cells, with mesh lines at the patches' sides for multiples of 20."""
    width = LENGTH / cells
    strip = je.Rectangle(LENGTH, width)
    patches = [_patch(*span, width, contact) for span, contact in zip(SPANS, contacts, strict=True)]
    skin = skin_of(strip, patches, PATTERN, sheet_resistance=SHEET)
    mesh = je.meshing.structured(strip, cells, 1)
    return je.discretise(je.Scene(skin), je.Fidelity(order=order, solver=Dense()), mesh=mesh)


def _exact(cells, contacts):
    patches = [Patch(*span, contact) for span, contact in zip(SPANS, contacts, strict=True)]
    return np.array([reading(patches, row, LENGTH / cells, SHEET) for row in PATTERN])


def _read(model, contacts):
    """Readings with other contacts than the model was made with."""
    theta = coefficients(model, None)._replace(contact=1 / jnp.asarray(contacts))
    return _of(transfer(model, theta))


def _of(z):
    z = np.asarray(z)
    return np.array([z[c, a] - z[d, a] - z[c, b] + z[d, b] for a, b, c, d in PATTERN])


@pytest.mark.parametrize("rho", [1e-12, 1e-6, 1e-2, 1.0, 1e6])
def test_two_patches_have_the_closed_form(rho):
    """R = R_s (L + 2 L_T coth(d / L_T)) / W with L between the inner rims, wherever the strip goes on beyond."""
    patches = [Patch(0.3, 0.4, rho), Patch(1.0, 1.1, rho)]
    found = reading(patches, [0, 1, 0, 1], 0.3, SHEET)
    assert found == pytest.approx(between_two_patches(0.6, 0.1, 0.3, SHEET, rho), rel=1e-14)


@pytest.mark.parametrize(("order", "cells", "rate"), [(1, 40, 2), (2, 40, 4)])
def test_area_patches_converge_at_full_rate(order, cells, rate):
    """Mesh lines follow the patches, so the field is smooth in each triangle and readings gain twice the
    order of the elements: unequal contacts, drive and four-terminal readings, patches that shunt what passes."""
    coarse, fine = (np.asarray(je.forward(_model(n, order))) / _exact(n, UNEVEN) - 1 for n in (cells, 2 * cells))
    assert (np.abs(fine) < {1: 1e-3, 2: 3e-6}[order]).all()
    assert (np.log2(coarse / fine) > rate - 0.15).all()


@pytest.mark.parametrize(("order", "cells", "bound"), [(1, 80, 0.2), (2, 40, 0.02)])
def test_contacts_over_twenty_decades(order, cells, bound):
    """Where the elements are shorter than the transfer length L the error falls with the power 2 or 4 of their
    ratio; where they are longer the mesh misses what L adds to the gaps, at most, and nothing is lost beyond."""
    model, size = _model(cells, order), LENGTH / cells
    for rho in 10.0 ** np.arange(-14, 9, 2):
        contacts = [rho] * len(SPANS)
        error = np.abs(_read(model, contacts) / _exact(cells, contacts) - 1)
        transfer_length = np.sqrt(rho / SHEET)
        resolved = bound * (size / transfer_length) ** (2 * order)
        missed = 2 * transfer_length / (SPANS[2][0] - SPANS[1][1])
        assert (error < min(resolved, missed) + 3e-12).all(), rho


@pytest.mark.parametrize("order", [1, 2])
def test_perfect_patches_short_what_they_cover(order):
    """The field between them is linear: exact on any mesh."""
    perfect = (0.0,) * len(SPANS)
    found = np.asarray(je.forward(_model(20, order, perfect)))
    np.testing.assert_allclose(found, _exact(20, perfect), rtol=1e-12)


def test_the_slope_in_the_contacts():
    """The derivative of the transfer matrix with respect to contact conductance, against the oracle's."""
    model = _model(80, 2)
    theta = coefficients(model, None)
    direction = np.array([1.0, -0.5, 2.0, 0.3])
    along = theta._replace(sigma=jnp.zeros_like(theta.sigma), contact=theta.contact * direction)
    _, slope = jax.jvp(lambda t: transfer(model, t), (theta,), (along,))
    step = 1e-4
    high, low = (_exact(80, np.array(UNEVEN) / (1 + h * direction)) for h in (step, -step))
    np.testing.assert_allclose(_of(slope), (high - low) / (2 * step), rtol=1e-3)


def _between_ends(contact, order, length=0.1, width=0.05):
    """A strip with an electrode along each short end, both driven and sensed."""
    ends = [(length, length + width), (2 * length + width, 2 * (length + width))]
    strip = je.Rectangle(length, width)
    skin = skin_of(strip, [je.BoundaryPatch(*end, contact) for end in ends], [[0, 1, 0, 1]], sheet_resistance=SHEET)
    mesh = je.meshing.structured(strip, 20, 10)
    return je.discretise(je.Scene(skin), je.Fidelity(order=order, solver=Dense()), mesh=mesh)


@pytest.mark.parametrize("order", [1, 2])
def test_between_its_ends_the_strip_is_exact_for_every_contact(order):
    """R = (R_s L + z1 + z2) / W: the elements hold the exact field, whatever the contact."""
    perfect = float(je.forward(_between_ends(0.0, order))[0])
    assert perfect == pytest.approx(between_ends(0.1, 0.05, SHEET, 0.0, 0.0), rel=1e-12)
    model = _between_ends(1.0, order)
    theta = coefficients(model, None)
    for contact in (1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e8):
        z = np.asarray(transfer(model, theta._replace(contact=1 / jnp.array([contact, 2 * contact]))))
        exact = between_ends(0.1, 0.05, SHEET, contact, 2 * contact)
        assert z[0, 0] - z[0, 1] - z[1, 0] + z[1, 1] == pytest.approx(exact, rel=1e-12), contact


def test_a_polygon_electrode_needs_a_mesh_that_follows_it():
    strip = je.Rectangle(LENGTH, 0.01)
    skin = skin_of(strip, [_patch(a, b, 0.01, 1e-3) for a, b in SPANS], PATTERN)
    with pytest.raises(je.skin.ElectrodeError, match="give a mesh whose edges follow it"):
        je.discretise(je.Scene(skin), mesh=je.meshing.structured(strip, 30, 2))
    with pytest.raises(ValueError, match="reaches the rim"):
        je.discretise(je.Scene(skin))
    with pytest.raises(je.skin.ElectrodeError, match="zero"):
        _patch(0.0, 0.1, 0.1, -1.0)


def test_the_middle_of_a_polygon_electrode():
    """Its centroid: of an L made of two rectangles, by hand."""
    bend = je.PolygonPatch(je.Polygon([(1, 1), (4, 1), (4, 2), (2, 2), (2, 3), (1, 3)]))
    np.testing.assert_allclose(bend.centre(je.Rectangle(9, 9)), [(3 * 2.5 + 1.5) / 4, (3 * 1.5 + 2.5) / 4], rtol=1e-14)
