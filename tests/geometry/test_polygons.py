"""Area electrodes of straight sides on meshes made for them."""

import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.meshing.elements import function_space
from jaxeit.meshing.generation import triangulate
from jaxeit.meshing.outlines import DiscFootprint, PointFootprint, PolygonFootprint, polygon_radius

from ..helpers import skin_of

SQUARE = je.Rectangle(0.2, 0.2)


def _pad(x, y, width, height, angle=0.0):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * [width, height]
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return je.Polygon(corners @ turn + [x, y])


SHAPES = {
    "rectangle": [_pad(0.1, 0.1, 0.02, 0.01)],
    "turned, and a small square": [_pad(0.1, 0.1, 0.02, 0.01, 0.3), _pad(0.05, 0.05, 0.003, 0.003)],
    "grid": [_pad(0.02 + 0.04 * i, 0.02 + 0.04 * j, 0.008, 0.004, 0.1 * i * j) for i in range(3) for j in range(4)],
    "bend": [je.Polygon([(0.05, 0.05), (0.1, 0.05), (0.1, 0.07), (0.07, 0.07), (0.07, 0.1), (0.05, 0.1)])],
    "narrow gap": [_pad(0.1, 0.1, 0.02, 0.01), _pad(0.1, 0.1121, 0.02, 0.01)],
    "narrow pad": [_pad(0.1, 0.1, 0.03, 0.001)],
    "near the rim": [_pad(0.011, 0.1, 0.02, 0.01)],
    "triangle": [je.Polygon([(0.05, 0.05), (0.1, 0.05), (0.1, 0.09)])],
    "cut corner": [je.Polygon([(0.09, 0.095), (0.1099, 0.095), (0.11, 0.0951), (0.11, 0.105), (0.09, 0.105)])],
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("edge_length", [0.02, 0.01])
def test_meshes_follow_polygons(name, edge_length):
    outlines = SHAPES[name]
    mesh = triangulate(SQUARE, [*map(PolygonFootprint, outlines), DiscFootprint((0.03, 0.185), 0.003)], edge_length)
    space = function_space(mesh, 1)
    for outline in outlines:
        under = je.PolygonPatch(outline).elements(space)  # refuses a mesh whose edges cross it
        assert mesh.areas[under].sum() == pytest.approx(outline.area, rel=1e-9)
    assert mesh.min_angles.min() > 25


def test_edges_around_a_polygon_are_short_only_where_they_must_be():
    """Sixteen edges around as asked for; many more where a neighbour is 0.2 mm away, on that side alone."""
    alone, close = (_pad(0.1, y, 0.02, 0.02) for y in (0.1, 0.1202))
    count = [
        len(_on_rim(triangulate(SQUARE, [PolygonFootprint(p) for p in pads], 0.02), alone))
        for pads in ([alone], [alone, close])
    ]
    assert count[0] == 16
    assert 0.02 / 2e-4 < count[1] < 1.3 * 0.02 / 2e-4
    fine = triangulate(SQUARE, [PolygonFootprint(alone, 80)], 0.02)
    assert len(_on_rim(fine, alone)) == 80


def _on_rim(mesh, outline):
    return np.flatnonzero(outline.boundary_distance(mesh.nodes) < 1e-9)


@pytest.mark.parametrize(
    ("footprints", "message"),
    [
        ([PolygonFootprint(_pad(0.005, 0.1, 0.02, 0.01))], r"electrode 0 \(polygon .*rim"),
        ([PolygonFootprint(_pad(0.01, 0.1, 0.02, 0.01))], "rim"),
        ([PointFootprint((0.1, 0.1)), PolygonFootprint(_pad(0.1, 0.1, 0.02, 0.01))], "overlap"),
        ([PolygonFootprint(_pad(0.1, 0.1, 0.02, 0.01)), DiscFootprint((0.1, 0.108), 0.004)], "overlap"),
        ([PolygonFootprint(_pad(0.1, 0.1, 0.02, 0.01)), PolygonFootprint(_pad(0.1, 0.1, 0.01, 0.02))], "overlap"),
        ([PolygonFootprint(_pad(0.1, 0.1, 0.02, 0.01)), PolygonFootprint(_pad(0.1, 0.1, 0.002, 0.002))], "overlap"),
        ([PolygonFootprint(_pad(0.1, 0.1, 0.1, 1e-4)), PolygonFootprint(_pad(0.1, 0.1, 1e-4, 0.1))], "overlap"),
        ([PolygonFootprint(_pad(0.1, 0.1, 0.02, 0.01)), PolygonFootprint(_pad(0.12, 0.1, 0.02, 0.006))], "overlap"),
        ([DiscFootprint((0.1, 0.1), 0.01), PolygonFootprint(_pad(0.1, 0.1, 0.002, 0.002))], "overlap"),
        ([PolygonFootprint(_pad(0.1, 0.1, 0.1, 1e-5))], "polygon from .* needs .* edges around it, above the limit"),
    ],
)
def test_polygons_that_cannot_be_placed(footprints, message):
    with pytest.raises(ValueError, match=message):
        triangulate(SQUARE, footprints, 0.02)


def test_a_polygon_across_a_notch_is_not_inside():
    """All of its corners are, and all of the notch's are outside it."""
    notched = je.Polygon([(0, 0), (0.1, 0), (0.1, 0.1), (0.06, 0.1), (0.05, 0.02), (0.04, 0.1), (0, 0.1)])
    with pytest.raises(ValueError, match="reaches the rim"):
        triangulate(notched, [PolygonFootprint(_pad(0.05, 0.06, 0.06, 0.01))], 0.02)


def test_segments_are_counted():
    with pytest.raises(ValueError, match="segments is 0; give a positive"):
        PolygonFootprint(SHAPES["triangle"][0], 0)


def test_a_polygon_of_many_sides_is_a_disc():
    """The same outline as an `AreaPatch` is meshed with, so the same readings to the meshes' difference."""
    places, angle = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.13)], 2 * np.pi * np.arange(16) / 16
    ring = polygon_radius(0.01, 16) * np.stack([np.cos(angle), np.sin(angle)], 1)
    bolts = [je.AreaPatch(p, 0.01, 1e-3) for p in places]
    pads = [je.PolygonPatch(je.Polygon(ring + p), 1e-3) for p in places]
    fidelity = je.Fidelity(edge_length=0.04, solver=Dense())
    models = [
        je.discretise(je.Scene(skin_of(SQUARE, e, [[0, 1, 0, 1], [0, 1, 2, 3]])), fidelity) for e in (bolts, pads)
    ]
    assert not np.asarray(models[0].system.lumped).any()
    round_ones, straight = (np.asarray(je.forward(m)) for m in models)
    np.testing.assert_allclose(straight, round_ones, rtol=5e-3)
