"""Meshes and electrodes at their limits: exact where there is anything to compute, one clear error where not."""

from fractions import Fraction

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..hard_sheet import MESH, SHEET
from ..hard_strip import capped, graded, strip_error
from ..helpers import skin_of
from ..oracles.rational import transfer_matrix


def test_a_mesh_graded_over_four_decades(hard):
    """Edges of 1 um at a point of the 200 mm strip; naive: geometry in single precision."""
    mesh = graded(1e-6)
    lengths = np.linalg.norm(np.diff(mesh.nodes[mesh.edges], axis=1)[:, 0], axis=1)
    assert lengths.max() / lengths.min() > 1e4
    double, single = (strip_error(mesh, dtype=d) for d in ("float64", "float32"))
    rounded = je.meshing.Mesh(mesh.nodes.astype(np.float32), mesh.triangles)
    naive = np.abs(rounded.areas / mesh.areas - 1).max()
    assert double < 1e-11
    assert single < 1e-4
    assert naive > 1e-3
    hard(
        "graded mesh",
        "edges of 1e-6 to 2e-2 m; naive: areas of triangles from nodes in single precision",
        float64=double,
        float32=single,
        naive=naive,
        beyond="an edge_length that asks for too many nodes: an error that says how many",
    )


def test_slivers_are_refused_and_would_cost_no_digits(hard):
    """Flat ones alone would: nothing but the angle shows them, as their area is what rounding makes of it."""
    for height in (1e-1, 1e-4, 1e-8):
        mesh = capped(height)
        double = strip_error(mesh)
        assert double < 1e-10
        with pytest.raises(
            je.meshing.MeshError, match=r"triangle \d+ at .* has an angle of .* accept such triangles with min_angle="
        ):
            je.meshing.Mesh(mesh.nodes, mesh.triangles).check()
    with np.errstate(divide="ignore", invalid="ignore"):
        assert np.isnan(strip_error(capped(1e-9)))
    hard(
        "slivers",
        "let through, of 1e-6 degrees; naive: of 1e-7 degrees, of area zero",
        float64=double,
        naive=np.nan,
        beyond="below 20 degrees no mesh is let through: an error that names the triangle and its place",
    )


def _readings(mesh, electrodes, contacts=None):
    """Electrode 0 driven against each other one and sensed there, on a sheet of unit conductivity."""
    count = len(electrodes)
    pattern = [[0, k, 0, k] for k in range(1, count)]
    domain = SHEET if mesh.nodes.max() > 1 else je.Polygon([(0, 0), (1, 0), (0, 1)])
    skin = skin_of(domain, electrodes, pattern)
    model = je.discretise(je.Scene(skin), je.Fidelity(solver=je.linalg.Dense()), mesh=mesh)
    theta = coefficients(model, None)
    if contacts is not None:
        theta = theta._replace(contact=1 / jnp.asarray(contacts))
    z = np.asarray(transfer(model, theta))
    return np.array([z[0, 0] - 2 * z[0, k] + z[k, k] for k in range(1, count)])


def _right(mesh, pieces, count):
    z = transfer_matrix(mesh.nodes, mesh.triangles.tolist(), np.ones(len(mesh.triangles)), pieces, count)
    return np.array([z[0, 0] - 2 * z[0, k] + z[k, k] for k in range(1, count)], float)


def _edges(mesh, *lines):
    """Boundary edges on lines ((x0, y0), (x1, y1)) parallel to an axis."""
    middles = mesh.nodes[mesh.boundary_edges].mean(1)
    on = [((middles >= np.min(line, 0)) & (middles <= np.max(line, 0))).all(1) for line in lines]
    return mesh.boundary_edges[np.any(on, 0)].tolist()


def test_electrodes_around_corners_and_where_the_arc_length_starts_anew(hard):
    electrodes = [je.BoundaryPatch(7.0, 9.0, 1.0), je.BoundaryPatch(23.0, 26.0, 2.0), je.BoundaryPatch(11.0, 13.0, 0.5)]
    lines = (
        [((7, 0), (8, 0)), ((8, 0), (8, 1))],
        [((0, 0), (0, 1)), ((0, 0), (2, 0))],
        [((8, 3), (8, 4)), ((7, 4), (8, 4))],
    )
    pieces = [(edge, k, 1 / Fraction(electrodes[k].contact)) for k in range(3) for edge in _edges(MESH, *lines[k])]
    assert len(pieces) == 7
    error = np.abs(_readings(MESH, electrodes) / _right(MESH, pieces, 3) - 1).max()
    assert error < 1e-13
    hard("electrodes around corners", "three of four corners", float64=error, beyond="longer than the rim: an error")


def test_a_hole_is_no_rim(hard):
    """Its edges are boundary too, under the nose of an electrode: by arc length alone they would touch it."""
    x, y = MESH.centroids.T
    mesh = je.meshing.Mesh(MESH.nodes, MESH.triangles[~((x > 5) & (x < 7) & (y > 2) & (y < 3))]).check()
    electrodes = [je.BoundaryPatch(0.0, 1.0, 1.0), je.BoundaryPatch(13.0, 15.0, 1.0)]
    rim = [(edge, 0, Fraction(1)) for edge in _edges(mesh, ((0, 0), (1, 0)))]
    rim += [(edge, 1, Fraction(1)) for edge in _edges(mesh, ((5, 4), (7, 4)))]
    right = _right(mesh, rim, 2)
    error = np.abs(_readings(mesh, electrodes) / right - 1).max()
    assert error < 1e-13
    naive = rim + [(edge, 1, Fraction(1)) for edge in _edges(mesh, ((5, 3), (7, 3)))]
    missed = np.abs(_right(mesh, naive, 2) / right - 1).max()
    assert missed > 0.1
    hard(
        "a hole in the mesh beside an electrode on the rim",
        "a hole of four triangles",
        float64=error,
        naive=missed,
        beyond="parts of the sheet that meet in one node, or not at all: an error that names the node",
    )


@pytest.mark.parametrize("contact", [1e-12, 1e-3, 1.0, 1e8])
def test_one_triangle_is_a_sheet(contact, hard):
    """Half a siemens along each leg: 2 ohm to the node at the edge's end, and from there the 2 x 2 system by hand."""
    triangle = je.meshing.Mesh(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]]))
    electrodes = [je.BoundaryPatch(0.0, 1.0, 1.0), je.PointElectrode((0.0, 1.0))]
    z = Fraction(contact)
    own, across = Fraction(1, 2) + 1 / (3 * z), 1 / (6 * z) - Fraction(1, 2)
    right = float(2 + own / (own**2 - across**2))
    found = _readings(triangle, electrodes, [contact, np.inf])
    error = abs(found[0] / right - 1)
    assert error < 1e-14
    hard("a mesh of one triangle", "contacts of 1e-12 to 1e8 Ω m", float64=error, beyond="no triangle: an error")


def test_electrodes_may_cover_every_node(hard):
    """No node is left to be the ground: an electrode is."""
    strip = je.Rectangle(3.0, 2.0)
    mesh = je.meshing.structured(strip, 3, 1)
    patches = [_rectangle(x, x + 1, 2.0) for x in (0.0, 2.0)]
    x = mesh.centroids[:, 0]
    pieces = [(t.tolist(), k, Fraction(1)) for k in (0, 1) for t in mesh.triangles[(x > 2 * k) & (x < 2 * k + 1)]]
    skin = skin_of(strip, patches, [[0, 1, 0, 1]])
    model = je.discretise(je.Scene(skin), je.Fidelity(solver=je.linalg.Dense()), mesh=mesh)
    right = _right(mesh, pieces, 2)[0]
    error = abs(float(je.forward(model)[0]) / right - 1)
    assert error < 1e-14
    unjoined = eqx.tree_at(lambda m: m.system.bridge_flux, model, jnp.zeros_like(model.system.bridge_flux))
    naive = abs(float(je.forward(unjoined)[0]) / right - 1)
    assert naive > 0.1
    hard(
        "electrodes over every node, one triangle apart",
        "two patches on three cells; naive: what a triangle joins only through its nodes",
        float64=error,
        naive=naive,
        beyond="no limit found",
    )


def _rectangle(start, stop, width):
    return je.PolygonPatch(je.Polygon([(start, 0.0), (stop, 0.0), (stop, width), (start, width)]), 1.0)


def test_a_bolt_cut_off_by_the_rim_conducts_with_what_is_left(hard):
    electrodes = [je.AreaPatch((4.0, 0.8), 1.6, 4.0), je.BoundaryPatch(13.0, 15.0, 1.0)]
    under = np.linalg.norm(MESH.centroids - [4.0, 0.8], axis=1) < 1.6
    covered = MESH.areas[under].sum() / (np.pi * 1.6**2)
    assert 0.5 < covered < 0.9
    pieces = [(t.tolist(), 0, Fraction(1, 4)) for t in MESH.triangles[under]]
    pieces += [(edge, 1, Fraction(1)) for edge in _edges(MESH, ((5, 4), (7, 4)))]
    error = np.abs(_readings(MESH, electrodes) / _right(MESH, pieces, 2) - 1).max()
    assert error < 1e-13
    with pytest.raises(
        je.skin.ElectrodeError, match=r"covers \d+ % of the bolt of radius 1.6 m at \(4.0, -0.8\); move it"
    ):
        _readings(MESH, [je.AreaPatch((4.0, -0.8), 1.6, 4.0), electrodes[1]])
    with pytest.raises(ValueError, match=r"electrode 0 \(disc .* outside|electrode 0 \(disc .* from"):
        je.discretise(je.Scene(skin_of(SHEET, electrodes, [[0, 1, 0, 1]])))
    hard(
        "a bolt cut off by the rim",
        f"{100 * covered:.0f} % of it on the sheet, on a mesh of one's own",
        float64=error,
        beyond="below 50 %: an error that says how much; meshes made here: an error that says how far to move it",
    )


def test_electrodes_that_share_the_sheet_are_refused(hard):
    """Overlapping, coincident, and one twice: on a mesh of one's own too."""
    bolt = je.AreaPatch((2.0, 2.0), 1.2, 4.0)
    for other in (bolt, je.AreaPatch((3.5, 2.0), 1.2, 4.0), je.PointElectrode((2.0, 2.0))):
        with pytest.raises(
            je.skin.ElectrodeError, match="electrodes 0 and 1 touch the same mesh node; move them apart"
        ):
            _readings(MESH, [bolt, other])
        with pytest.raises(ValueError, match=r"electrode 0 .* electrode 1 .*; move them apart"):
            je.discretise(je.Scene(skin_of(SHEET, [bolt, other], [[0, 1, 0, 1]])))
    hard("overlapping or coincident electrodes", "any", beyond="an error that names both")


@pytest.mark.parametrize(("wrong", "said"), [({"order": 7}, "give one of"), ({"interpolation": 0.5}, "give 0 to 0.1")])
def test_settings_of_a_mesh_that_cannot_be_are_refused(wrong, said):
    with pytest.raises(je.model.FidelityError, match=f"{next(iter(wrong))} is .*; {said}"):
        je.Fidelity(**wrong)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"edge_length": "x"}, "edge_length is 'x'; give 0.001 to 0.25"),
        ({"order": [1]}, r"order is \[1\]; give one of \[1, 2\]"),
        ({"electrode_segments": "8"}, "electrode_segments is '8'; give 6 to 4096"),
        ({"growth": None}, "growth is None; give 1.05 to 2"),
        ({"dtype": "bogus"}, "dtype is 'bogus'; give float64 or float32"),
        (
            {"solver": "x"},
            r"solver: 'x' is not a linear solver; give None, or an object, such as solver=jaxeit.linalg.De",
        ),
        ({"solver": je.linalg.Dense}, "solver: the class Dense is not a linear solver"),
    ],
)
def test_settings_of_a_wrong_kind_are_refused_in_one_line(wrong, said):
    with pytest.raises(je.model.FidelityError, match=f"^{said}"):
        je.Fidelity.draft(**wrong)


@pytest.mark.parametrize("wrong", [{"columns": 0}, {"rows": 2001}])
def test_pixels_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} is .*; give 1 to 2000, a whole number"):
        je.Pixels(**wrong)
