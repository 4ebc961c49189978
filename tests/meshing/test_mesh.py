"""Domains, meshes and the mesher: geometry against closed forms, footprints to rounding."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import jaxeit as je
from jaxeit.geometry.shapes import Disc, Polygon, Rectangle
from jaxeit.meshing import generation
from jaxeit.meshing.foreign import flat_mesh, read_mesh, write_mesh
from jaxeit.meshing.generation import Mesh, MeshError, TrianglePattern, structured, triangulate
from jaxeit.meshing.outlines import ArcFootprint, DiscFootprint, PointFootprint, polygon_radius
from jaxeit.meshing.smoothing import Triangulation
from jaxeit.meshing.triangles import CROWDED
from jaxeit.skin.electrodes.base import require_contact

L_SHAPE = Polygon(((0, 0), (0.2, 0), (0.2, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2)))
SQUARE = Rectangle(0.2, 0.2)
TANK = Disc(0.03)
DOMAINS = [Rectangle(0.2, 0.1), Disc(0.03, (1.0, -2.0)), L_SHAPE]


def bolts(margin):
    places = np.linspace(margin, 0.2 - margin, 5)
    return [DiscFootprint((x, y), 0.003) for y in places for x in places]


def arcs(domain, share, count=16):
    sector = domain.perimeter / count
    return [ArcFootprint((k - share / 2) * sector, (k + share / 2) * sector) for k in range(count)]


def points_of(footprints):
    return [PointFootprint(f.position) for f in footprints]


CASES = {
    "bolts": (SQUARE, bolts(0.02)),
    "bolts near the rim": (SQUARE, bolts(0.01)),
    "half arcs": (TANK, arcs(TANK, 0.5)),
    "fifth arcs": (TANK, arcs(TANK, 0.2)),
    "points": (SQUARE, points_of(bolts(0.02))),
    "points on the rim": (
        TANK,
        [PointFootprint(tuple(p)) for p in TANK.boundary_point(np.arange(16) * TANK.perimeter / 16)],
    ),
    "L": (
        L_SHAPE,
        [
            DiscFootprint((0.03, 0.03), 0.003),
            DiscFootprint((0.15, 0.05), 0.004, 12),
            PointFootprint((0.05, 0.15)),
            PointFootprint((0.2, 0.0)),
            ArcFootprint(0.38, 0.42),
            ArcFootprint(0.79, 0.81),
        ],
    ),
    "bare": (Rectangle(0.2, 0.03), []),
}
EDGES = [0.02, 0.005]


@pytest.fixture(scope="module")
def meshes():
    """Every case at every edge length, made once."""
    return {(name, edge): triangulate(*CASES[name], edge) for name, edge in itertools.product(CASES, EDGES)}


every_mesh = pytest.mark.parametrize(("name", "edge"), list(itertools.product(CASES, EDGES)))


def edge_lengths(mesh):
    return np.linalg.norm(np.diff(mesh.nodes[mesh.edges], axis=1)[:, 0], axis=1)


def distance_to_nearest_node(mesh, points):
    return np.linalg.norm(mesh.chart[:, None] - np.asarray(points), axis=2).min(0)


# Domains


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
def test_rim_and_arc_length_are_inverse(domain):
    s = np.linspace(0, domain.perimeter, 101, endpoint=False)
    rim = domain.boundary_point(s)
    assert_allclose(domain.boundary_coordinate(rim), s, atol=1e-14)
    assert_allclose(domain.boundary_point(s + 3 * domain.perimeter), rim, atol=1e-14)
    assert domain.boundary_distance(rim).max() < 1e-14
    assert domain.contains(rim).all()


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
def test_rim_runs_counter_clockwise_around_the_area(domain):
    a = domain.boundary_point(np.linspace(0, domain.perimeter, 6001)[:-1])
    b = np.roll(a, -1, axis=0)
    assert_allclose(np.linalg.norm(b - a, axis=1).sum(), domain.perimeter, rtol=1e-6)
    assert_allclose(0.5 * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), domain.area, rtol=1e-4)


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
def test_contains_and_distance_agree_with_brute_force(domain):
    rng = np.random.default_rng(0)
    low, high = np.asarray(domain.bounds)
    points = rng.uniform(low - 0.1 * (high - low), high + 0.1 * (high - low), (4000, 2))
    rim = domain.boundary_point(np.linspace(0, domain.perimeter, 2000))
    brute = np.array([np.linalg.norm(rim - p, axis=1).min() for p in points[:200]])
    step = domain.perimeter / 2000
    assert np.all(np.abs(domain.boundary_distance(points[:200]) - brute) < step)
    share = domain.contains(points).mean() * 1.44 * np.prod(high - low)
    assert_allclose(share, domain.area, rtol=0.05)


def test_rectangle_and_disc_by_hand():
    box = Rectangle(0.2, 0.1)
    assert box.bounds == ((0.0, 0.0), (0.2, 0.1))
    assert_allclose(box.corners, [0, 0.2, 0.3, 0.5])
    assert_allclose(box.boundary_point(0.25), [0.2, 0.05])
    assert_array_equal(box.contains([[0.2, 0.1], [0.1, 0.05], [0.2001, 0.05]]), [True, True, False])
    assert_allclose(box.boundary_distance([[0.1, 0.02], [0.3, 0.2]]), [0.02, np.hypot(0.1, 0.1)])
    disc = Disc(0.03, (1.0, 0.0))
    assert_allclose(disc.boundary_point(0.03 * np.pi / 2), [1.0, 0.03], atol=1e-15)
    assert disc.corners.size == 0
    assert_allclose(disc.boundary_distance([[1.0, 0.0]]), [0.03])


def test_clockwise_polygon_is_turned_round():
    backward = Polygon(L_SHAPE.vertices[::-1])
    assert_allclose(backward.area, 0.03)
    assert backward.vertices[0] == L_SHAPE.vertices[-1]
    assert_allclose(backward.perimeter, L_SHAPE.perimeter)


def test_clearance_is_the_width_across():
    assert_allclose(Rectangle(0.2, 0.01).clearance([0.1]), [0.01])
    assert np.isinf(TANK.clearance([0.01])).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Rectangle(-1, 1), "Rectangle: width is -1; give a positive length"),
        (lambda: Rectangle(1, np.nan), "Rectangle: height is nan"),
        (lambda: Rectangle("1", 2), "Rectangle: width is '1'; give a positive length in metres"),
        (lambda: Rectangle(1, None), "Rectangle: height is None; give a positive length in metres"),
        (lambda: Disc(1.0, ("a", "b")), "Disc: centre is"),
        (lambda: je.Cylinder("1"), "the surface's radius is '1' m; give a length above zero"),
        (lambda: require_contact("1", "ohm"), "an electrode's contact is '1'"),
        (lambda: Disc(0.0), "Disc: radius is 0.0"),
        (lambda: Disc(1.0, (0.0, np.inf)), "Disc: centre is"),
        (lambda: Polygon(((0, 0), (1, 0))), "three or more"),
        (lambda: Polygon(((0, 0), (1, 0), (1, np.nan))), "vertex 2 is"),
        (lambda: Polygon(((0, 0), (1, 0), (1, 1), (0, 0))), "vertices 3 and 0 coincide"),
        (lambda: Polygon(((0, 0), (1, 1), (1, 0), (0, 1))), "sides from vertices 0 and 2 meet"),
        (lambda: Polygon(((0, 0), (2, 0), (1, 0), (1, 1))), "sides from vertices 0 and 1 meet"),
        (lambda: SQUARE.contains(np.zeros(3)), r"points have shape \(3,\)"),
        (lambda: DiscFootprint((0, 0), -1.0), "DiscFootprint: radius is -1.0"),
        (lambda: DiscFootprint((0, 0), 1.0, 5), "segments is 5; give 6 to 12 times a power of two"),
        (lambda: DiscFootprint((0, 0), 1.0, 26), "segments is 26"),
        (lambda: PointFootprint((0, np.nan)), "PointFootprint: position is"),
        (lambda: ArcFootprint(0.1, 0.1), "start before stop"),
    ],
)
def test_bad_shapes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# Graded meshes


@every_mesh
def test_mesh_is_sound(meshes, name, edge):
    mesh, domain = meshes[name, edge], CASES[name][0]
    assert mesh.check() is mesh
    assert len(mesh.nodes) - len(mesh.edges) + len(mesh.triangles) == 1
    assert mesh.min_angles.min() > 26
    assert mesh.triangles.dtype == np.int32
    assert mesh.nodes.dtype == np.float64
    assert edge_lengths(mesh).max() < 1.8 * edge
    rim = np.unique(mesh.boundary_edges)
    assert domain.boundary_distance(mesh.chart[rim]).max() < domain.tolerance
    assert_array_equal(rim, np.arange(len(rim)))


@every_mesh
def test_areas_add_up(meshes, name, edge):
    mesh, domain = meshes[name, edge], CASES[name][0]
    if isinstance(domain, Disc):
        ends = mesh.chart[mesh.boundary_edges]
        turns = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / domain.radius
        # A chord cuts off a segment of radius^2 (angle - sin angle) / 2.
        angle = 2 * np.arcsin(turns / 2)
        missing = np.sum(angle - np.sin(angle)) * domain.radius**2 / 2
        assert_allclose(mesh.areas.sum(), domain.area - missing, rtol=1e-12)
        assert missing < domain.area * edge**2 / domain.radius**2
    else:
        assert_allclose(mesh.areas.sum(), domain.area, rtol=1e-12)


@every_mesh
def test_footprints_are_followed(meshes, name, edge):
    mesh, (domain, footprints) = meshes[name, edge], CASES[name]
    corners = domain.boundary_point(domain.corners)
    wanted = [corners] + [
        domain.boundary_point([f.start, f.stop]) if isinstance(f, ArcFootprint) else np.array([f.position])
        for f in footprints
    ]
    assert distance_to_nearest_node(mesh, np.concatenate(wanted)).max() < 1e-15


@every_mesh
def test_discs_have_their_exact_area(meshes, name, edge):
    mesh, footprints = meshes[name, edge], CASES[name][1]
    for disc in (f for f in footprints if isinstance(f, DiscFootprint)):
        away = np.linalg.norm(mesh.chart_centroids - disc.position, axis=1)
        inside = away < disc.radius
        assert_allclose(mesh.areas[inside].sum(), np.pi * disc.radius**2, rtol=1e-12)
        ring = np.linalg.norm(mesh.chart - disc.position, axis=1)
        on_ring = np.abs(ring - polygon_radius(disc.radius, disc.segments)) < 1e-15
        assert on_ring.sum() == disc.segments


@every_mesh
def test_sizes_change_gently(meshes, name, edge):
    mesh = meshes[name, edge]
    size = np.sqrt(mesh.areas)
    shared = np.sort(np.concatenate([mesh.triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]))
    order = np.lexsort(shared.T)
    owner, shared = np.tile(np.arange(len(size)), 3)[order], shared[order]
    same = (shared[1:] == shared[:-1]).all(1)
    ratio = size[owner[1:][same]] / size[owner[:-1][same]]
    assert np.maximum(ratio, 1 / ratio).max() < 2.2


def test_arcs_have_at_least_two_edges_and_nothing_but_edges():
    mesh = triangulate(TANK, arcs(TANK, 0.2), 0.02)
    middles = TANK.boundary_coordinate(mesh.chart[mesh.boundary_edges].mean(1))
    for arc in arcs(TANK, 0.2):
        under = (middles - arc.start) % TANK.perimeter < arc.stop - arc.start
        ends = mesh.chart[mesh.boundary_edges[under]]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        assert len(length) >= 2
        angle = 2 * np.arcsin(length / (2 * TANK.radius))
        assert_allclose(angle.sum() * TANK.radius, arc.stop - arc.start, rtol=1e-12)


def test_edges_at_electrodes_can_be_set():
    centre = (0.1, 0.1)
    mesh = triangulate(SQUARE, [PointFootprint(centre)], 0.02, electrode_edge=0.0005)
    hub = int(np.argmin(np.linalg.norm(mesh.chart - centre, axis=1)))
    around = edge_lengths(mesh)[(mesh.edges == hub).any(1)]
    assert 0.0003 < around.mean() < 0.0009
    assert edge_lengths(mesh).max() > 0.012


def test_growth_sets_the_number_of_nodes():
    slow, fast = (
        len(triangulate(SQUARE, [DiscFootprint((0.1, 0.1), 0.003)], 0.01, growth=g).nodes) for g in (1.15, 1.6)
    )
    assert slow > 1.5 * fast


def test_discs_get_more_segments_where_edges_are_shorter():
    disc = DiscFootprint((0.1, 0.1), 0.02, 8)
    mesh = triangulate(SQUARE, [disc], 0.006)
    ring = np.linalg.norm(mesh.chart - disc.position, axis=1)
    assert np.sum(np.abs(ring - polygon_radius(0.02, 32)) < 1e-15) == 32


@pytest.mark.parametrize("gap", [1e-3, 1e-4, 1e-6])
def test_points_close_to_the_rim_and_to_each_other(gap):
    footprints = [
        PointFootprint((0.1, gap)),
        PointFootprint((0.05, 0.1)),
        PointFootprint((0.05 + gap, 0.1)),
    ]
    mesh = triangulate(SQUARE, footprints, 0.02)
    assert mesh.min_angles.min() > 20
    assert len(mesh.nodes) < 3000


def test_same_input_same_mesh():
    a, b = (triangulate(*CASES["L"], 0.01) for _ in range(2))
    assert_array_equal(a.nodes, b.nodes)
    assert_array_equal(a.triangles, b.triangles)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    x=st.floats(0.02, 0.08),
    y=st.floats(0.02, 0.08),
    radius=st.floats(0.001, 0.012),
    segments=st.sampled_from([6, 7, 8, 12, 16, 20, 24]),
    start=st.floats(0, 0.8),
    length=st.floats(0.001, 0.1),
    edge=st.floats(0.006, 0.03),
)
def test_anything_apart_can_be_meshed(x, y, radius, segments, start, length, edge):
    footprints = [DiscFootprint((x, y), radius, segments), ArcFootprint(start, start + length)]
    mesh = triangulate(L_SHAPE, footprints, edge)
    assert_allclose(mesh.areas.sum(), L_SHAPE.area, rtol=1e-12)


@pytest.mark.slow
def test_where_one_start_ends_in_flat_triangles_another_is_tried(monkeypatch):
    moved = np.array([d.position for d in bolts(0.02)]) + np.random.default_rng(3).normal(0, 0.003, (25, 2))
    footprints = [DiscFootprint(tuple(place), 0.003, segments=8) for place in moved.tolist()]
    assert triangulate(SQUARE, footprints, 0.012, growth=1.6).min_angles.min() > 20
    monkeypatch.setattr(generation, "START_SPACINGS", generation.START_SPACINGS[:1])
    with pytest.raises(MeshError, match=r"an angle of 18\.4 degrees"):
        triangulate(SQUARE, footprints, 0.012, growth=1.6)


def test_fine_testbed_mesh():
    mesh = triangulate(*CASES["bolts"], 0.0015)
    assert len(mesh.nodes) > 15_000
    assert mesh.min_angles.min() > 26


BOLT = DiscFootprint((0.05, 0.05), 0.003)


@pytest.mark.parametrize(
    ("footprints", "options", "message"),
    [
        ([], {"edge_length": 0.0}, "edge_length is 0.0; give a positive length"),
        ([], {"edge_length": 0.01, "electrode_edge": -1}, "electrode_edge is -1"),
        ([], {"edge_length": 0.01, "growth": 1.0}, "growth is 1.0"),
        ([], {"edge_length": 1e-5}, "check that lengths are in metres"),
        (
            [BOLT, DiscFootprint((0.001, 0.1), 0.003)],
            {"edge_length": 0.01},
            r"electrode 1 \(disc at \(1.00, 100.00\) mm\) of radius 3.00 mm is only 1.00 mm from",
        ),
        (
            [PointFootprint((0.3, 0.1))],
            {"edge_length": 0.01},
            r"electrode 0 \(point at .* is 100.00 mm outside the domain",
        ),
        (
            [DiscFootprint((0.1, 0.1), 0.003), BOLT, DiscFootprint((0.053, 0.05), 0.003)],
            {"edge_length": 0.01},
            r"electrode 1 \(disc .* and electrode 2 \(disc .* overlap or touch; move them apart",
        ),
        (
            [BOLT, PointFootprint((0.051, 0.05))],
            {"edge_length": 0.01},
            "electrode 0 .* electrode 1",
        ),
        (
            [ArcFootprint(0.7, 0.85), ArcFootprint(0.04, 0.06)],
            {"edge_length": 0.01},
            r"electrode 0 \(arc 700.00 to 850.00 mm\) and electrode 1 \(arc .* overlap",
        ),
        (
            [ArcFootprint(0.04, 0.06), PointFootprint((0.05, 0.0))],
            {"edge_length": 0.01},
            "electrode 0 .* electrode 1",
        ),
        ([ArcFootprint(0.0, 1.0)], {"edge_length": 0.01}, "longer than the rim"),
    ],
)
def test_impossible_requests_are_refused(footprints, options, message):
    with pytest.raises(ValueError, match=message):
        triangulate(SQUARE, footprints, **options)


def test_a_spike_ends_in_a_mesh_error():
    with pytest.raises(MeshError, match=r"has an angle of .* use a shorter edge_length"):
        triangulate(Polygon(((0, 0), (0.2, 0), (0.2, 0.02))), [], 0.02)


def test_an_outline_that_is_lost_is_not_passed_over(monkeypatch):
    coarse = structured(SQUARE, 1, 1)
    lost = Triangulation(-1.0, coarse.nodes, coarse.triangles)
    monkeypatch.setattr("jaxeit.meshing.generation.relax", lambda problem, free: lost)
    with pytest.raises(MeshError, match=r"cannot follow the outline at \(.*\) mm; use a shorter"):
        triangulate(SQUARE, [], 0.02)


# Meshes as values


@pytest.mark.parametrize("pattern", TrianglePattern)
def test_structured_mesh(pattern):
    mesh = structured(Rectangle(0.3, 0.2), 6, 4, pattern=pattern).check(30)
    assert_allclose(mesh.areas.sum(), 0.06, rtol=1e-14)
    assert len(mesh.triangles) == {TrianglePattern.CROSSED: 96}.get(pattern, 48)
    # Row by row, x inner; middles of cells after the corners.
    assert_allclose(mesh.nodes[1], [0.05, 0.0])
    assert_allclose(mesh.nodes[7], [0.0, 0.05])
    assert len(mesh.nodes) == 35 + (24 if pattern is TrianglePattern.CROSSED else 0)


def symmetric(mesh, mapping):
    """Whether mapped nodes are nodes and mapped triangles are triangles."""
    index = {tuple(p): i for i, p in enumerate(mesh.nodes.round(9))}
    image = np.array([index[tuple(p)] for p in mapping(mesh.nodes).round(9)])
    own = {frozenset(t) for t in mesh.triangles.tolist()}
    return own == {frozenset(t) for t in image[mesh.triangles].tolist()}


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [(TrianglePattern.RISING, False), (TrianglePattern.ALTERNATING, True), (TrianglePattern.CROSSED, True)],
)
def test_mirrors_and_quarter_turns(pattern, expected):
    mesh = structured(Rectangle(1.0, 1.0), 4, 4, pattern=pattern)
    assert symmetric(mesh, lambda p: np.stack([1 - p[:, 0], p[:, 1]], 1)) is expected
    assert symmetric(mesh, lambda p: np.stack([1 - p[:, 1], p[:, 0]], 1)) is expected
    assert symmetric(mesh, lambda p: p[:, ::-1])


@pytest.mark.parametrize(("nx", "ny"), [(0, 1), (2, 1.5)])
def test_structured_needs_whole_cells(nx, ny):
    with pytest.raises(ValueError, match="whole number of cells"):
        structured(SQUARE, nx, ny)


def test_boundary_edges_keep_the_sheet_on_their_left():
    mesh = structured(Rectangle(1.0, 1.0), 2, 2)
    a, b = mesh.nodes[mesh.boundary_edges].transpose(1, 0, 2)
    assert len(a) == 8
    assert_allclose(0.5 * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1.0)


def cylinder(radius):
    def surface(chart):
        angle = chart[:, 0] / radius
        return np.stack([radius * np.sin(angle), chart[:, 1], radius * np.cos(angle)], 1)

    return surface


def test_lift_onto_a_cylinder_keeps_areas_to_second_order():
    flat = structured(SQUARE, 10, 10, pattern=TrianglePattern.CROSSED)
    radius = 0.15
    error = []
    for mesh in (flat, flat.refine()):
        curved = mesh.lift(cylinder(radius)).check()
        assert curved.nodes.shape == (len(mesh.nodes), 3)
        assert_array_equal(curved.chart, mesh.chart)
        assert_allclose(np.hypot(curved.nodes[:, 0], curved.nodes[:, 2]), radius)
        error.append(1 - curved.areas.sum() / SQUARE.area)
    assert 0 < error[0] < 0.001
    assert 3.8 < error[0] / error[1] < 4.2


def test_refine_quarters_every_triangle():
    mesh = triangulate(L_SHAPE, [DiscFootprint((0.03, 0.03), 0.003)], 0.02)
    fine = mesh.refine().check()
    assert len(fine.triangles) == 4 * len(mesh.triangles)
    assert len(fine.nodes) == len(mesh.nodes) + len(mesh.edges)
    assert_array_equal(fine.nodes[: len(mesh.nodes)], mesh.nodes)
    assert_allclose(fine.areas.reshape(4, -1), np.tile(mesh.areas / 4, (4, 1)), rtol=1e-9)
    assert_allclose(fine.min_angles.min(), mesh.min_angles.min())


def test_refine_on_a_surface_puts_new_nodes_on_it():
    mesh = structured(SQUARE, 4, 4).lift(cylinder(0.15))
    radii = [np.hypot(*m.nodes[:, [0, 2]].T) for m in (mesh.refine(), mesh.refine(cylinder(0.15)))]
    assert radii[0].min() < 0.1499
    assert_allclose(radii[1], 0.15)


def test_meshes_cannot_be_changed():
    mesh = structured(SQUARE, 1, 1)
    with pytest.raises(ValueError, match="read-only"):
        mesh.nodes[0] = 1.0


CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def _with(array, row, value):
    array = array.copy()
    array[row] = value
    return array


@pytest.mark.parametrize(
    ("nodes", "triangles", "message"),
    [
        (_with(CORNERS, 2, np.nan), TWO, "node 2 is at .* not finite"),
        (CORNERS, _with(TWO, 1, [0, 2, 4]), r"triangle 1 has nodes \[0, 2, 4\].*0 to 3"),
        (CORNERS, TWO[:1], r"node 3 at \(0.00, 1000.00\) mm belongs to no triangle"),
        (
            np.concatenate([CORNERS, CORNERS[[0, 2]]]),
            np.array([[0, 1, 2], [4, 5, 3]]),
            r"nodes 0 and 4 are both at \(0.00, 0.00\) mm \(2 such pairs\)",
        ),
        (CORNERS, TWO[:, [0, 2, 1]], "triangle 0 at .* list its nodes counter-clockwise"),
        (_with(CORNERS, 3, [0.5, 0.5]), TWO, "triangle 1 .* has area 0 mm"),
        (
            np.concatenate([CORNERS, [[0.3, 2.0]]]),
            np.array([[0, 1, 2], [0, 2, 3], [0, 2, 4]]),
            "edge between nodes 0 and 2 .* overlapping",
        ),
        (
            np.concatenate([CORNERS, CORNERS[1:] + 1])[[0, 1, 2, 4, 5]],
            np.array([[0, 1, 2], [2, 3, 4]]),
            r"meet only in node 2 at \(1000.00, 1000.00\) mm",
        ),
        (
            np.concatenate([CORNERS, CORNERS[:3] + 2]),
            np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]]),
            "2 separate pieces; the smallest holds node 4",
        ),
        (
            _with(CORNERS, 3, [-0.1, 0.0]),
            TWO,
            r"triangle 1 at \(300.00, 333.33\) mm has an angle of 2.7 degrees \(1 triangles",
        ),
    ],
)
def test_check_names_what_is_wrong(nodes, triangles, message, hard):
    with pytest.raises(MeshError, match=message):
        Mesh(nodes, triangles).check()
    hard(
        "unsound meshes",
        "nodes not finite, unused or twice; triangles turned round, flat or overlapping; sheets in pieces",
        beyond="an error that names the node or triangle, its place and what to do",
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((CORNERS[:, :1], TWO), r"nodes has shape \(4, 1\)"),
        ((CORNERS, TWO.ravel()), r"triangles has shape \(6,\)"),
        ((CORNERS, TWO.astype(float)), "whole node numbers"),
        ((CORNERS, TWO, CORNERS[:3]), "4 nodes but 3 chart positions"),
        ((np.zeros((4, 3)), TWO), r"chart has shape \(4, 3\)"),
    ],
)
def test_wrong_shapes_are_refused(arguments, message):
    with pytest.raises(MeshError, match=message):
        Mesh(*arguments)


def test_a_surface_must_give_points_in_space():
    with pytest.raises(MeshError, match="must map"):
        structured(SQUARE, 1, 1).lift(lambda chart: chart)


def test_a_flat_triangle_of_a_foreign_mesh_is_accepted_by_its_angle():
    """The advice is about that mesh; where jaxeit makes the mesh it is about its edge length."""
    nodes = np.array([[0, 0], [1, 0], [2, 0], [1, 0.2], [1, -0.9]])
    mesh = Mesh(nodes, np.array([[0, 1, 3], [1, 2, 3], [0, 4, 1], [1, 4, 2]]))
    ends = tuple(je.PointElectrode((float(x), float(y))) for x, y in nodes[[0, 4, 2, 3]])
    sheet = je.Polygon(nodes[[0, 4, 2, 3]])
    scene = je.Scene(je.Skin("kite", sheet, 1.0, ends, je.Protocol(np.array([[0, 1, 2, 3]]))))
    with pytest.raises(MeshError, match=r"angle of 11\.3 degrees .* accept such triangles with min_angle="):
        je.discretise(scene, mesh=mesh)
    with pytest.raises(MeshError, match="use a shorter edge_length"):
        mesh.check(advice=CROWDED)
    assert np.isfinite(np.asarray(je.forward(je.discretise(scene, mesh=mesh, min_angle=10)))).all()


def test_meshes_of_other_programs(tmp_path):
    """Any numbering and direction; files that meshio knows, with values on the triangles."""
    own = structured(SQUARE, 4, 3)
    nodes = np.concatenate([[[9.0, 9.0]], own.nodes])
    clockwise = own.triangles.copy()
    clockwise[::2] = clockwise[::2, ::-1]
    mesh, number = flat_mesh(nodes, clockwise + 1)
    assert_array_equal(mesh.nodes, own.nodes)
    assert_array_equal(number, np.arange(-1, len(own.nodes)))
    assert_allclose(mesh.check().areas, own.areas)
    with pytest.raises(MeshError, match="its triangles name nodes outside 0 to 20"):
        flat_mesh(nodes, clockwise + 2)
    with pytest.raises(MeshError, match="its nodes are at different heights"):
        flat_mesh(np.random.default_rng(0).normal(size=(21, 3)), clockwise)

    meshio = pytest.importorskip("meshio")
    sigma = np.arange(len(mesh.triangles), dtype=float)
    for name in ("a.vtu", "a.vtk"):
        write_mesh(tmp_path / name, mesh, sigma=sigma)
        assert_array_equal(meshio.read(tmp_path / name).cell_data["sigma"][0], sigma)
        again = read_mesh(tmp_path / name)
        assert_array_equal(again.nodes, mesh.nodes)
        assert_array_equal(again.triangles, mesh.triangles)
    with pytest.raises(MeshError, match=r"sigma has shape \(3,\); the mesh has 24 triangles"):
        write_mesh(tmp_path / "b.vtu", mesh, sigma=np.zeros(3))
    (tmp_path / "c.vtk").write_text("no mesh")
    with pytest.raises(MeshError, match=r"c\.vtk: meshio cannot read it"):
        read_mesh(tmp_path / "c.vtk")
    meshio.write_points_cells(tmp_path / "d.vtu", np.zeros((3, 3)), [("line", np.array([[0, 1]]))])
    with pytest.raises(MeshError, match=r"has no triangles, but \['line'\]"):
        read_mesh(tmp_path / "d.vtu")
