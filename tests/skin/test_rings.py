"""Ring electrodes: an outline, an electrode and a form in the skin file, all in one module."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.meshing.elements import function_space
from jaxeit.meshing.generation import triangulate
from jaxeit.meshing.outlines import DiscFootprint, PointFootprint, PolygonFootprint, polygon_radius
from jaxeit.skin.electrodes.rings import RingFootprint

from ..helpers import skin_of
from .test_skin import _with_electrodes

SQUARE = je.Rectangle(0.2, 0.2)
PLACES = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.13)]
PATTERN = [[0, 1, 0, 1], [0, 1, 2, 3], [2, 3, 0, 1], [1, 2, 3, 0], [3, 0, 1, 2]]


def ring(x=0.1, y=0.1, inner=0.004, outer=0.01, **segments):
    return RingFootprint((x, y), inner, outer, **segments)


def on_circle(mesh, centre, radius):
    away = np.linalg.norm(mesh.chart - np.asarray(centre), axis=1)
    return np.count_nonzero(np.abs(away - radius) < 1e-12)


@pytest.mark.parametrize("edge_length", [0.02, 0.005])
@pytest.mark.parametrize(("inner", "outer"), [(0.004, 0.01), (0.009, 0.01), (0.0005, 0.01), (0.02, 0.05)])
def test_the_mesh_follows_both_circles(inner, outer, edge_length):
    mesh = triangulate(SQUARE, [ring(inner=inner, outer=outer)], edge_length)
    electrode = je.skin.RingPatch((0.1, 0.1), inner, outer)
    under = electrode.elements(function_space(mesh, 1))
    assert mesh.areas[under].sum() == pytest.approx(np.pi * (outer**2 - inner**2), rel=1e-9)
    assert mesh.min_angles.min() > 25
    for radius in (inner, outer):
        numbers = [16 * 2**k for k in range(8)]
        counts = [n for n in numbers if on_circle(mesh, (0.1, 0.1), polygon_radius(radius, n)) == n]
        assert len(counts) == 1
        assert 2 * np.pi * radius / counts[0] <= 1.3 * min(edge_length, outer - inner) + 1e-12


def test_other_electrodes_fit_into_the_hole():
    inside = [DiscFootprint((0.1, 0.1), 0.003), PointFootprint((0.106, 0.1))]
    beside = [ring(0.15, 0.1, 0.01, 0.02), ring(0.1, 0.1, 0.012, 0.018), ring(0.15, 0.1, 0.004, 0.008)]
    mesh = triangulate(SQUARE, [*inside, *beside], 0.02)
    assert mesh.min_angles.min() > 20
    space = function_space(mesh, 1)
    for f in beside:
        electrode = je.skin.RingPatch(f.position, f.inner, f.outer)
        assert mesh.areas[electrode.elements(space)].sum() == pytest.approx(np.pi * (f.outer**2 - f.inner**2))


def _pad(x, y, width, height):
    return PolygonFootprint(je.Polygon([(x, y), (x + width, y), (x + width, y + height), (x, y + height)]))


@pytest.mark.parametrize(
    ("footprints", "message"),
    [
        ([ring(0.005)], r"electrode 0 \(ring at \(5.00, 100.00\) mm\) of radius 10.00 mm is only 5.00 mm from the rim"),
        ([ring(0.3)], r"electrode 0 \(ring .*\) is 100.00 mm outside the domain"),
        ([ring(), DiscFootprint((0.107, 0.1), 0.001)], r"electrode 0 \(ring .* and electrode 1 \(disc .* overlap"),
        ([DiscFootprint((0.1, 0.1), 0.00395), ring()], "electrode 0 .disc .* electrode 1 .ring .* overlap"),
        ([ring(), DiscFootprint((0.1, 0.1), 0.02)], "overlap"),
        ([PointFootprint((0.1, 0.107)), ring()], "overlap"),
        ([ring(), ring(0.115)], "overlap"),
        ([ring(), ring(inner=0.002, outer=0.02)], "overlap"),
        ([ring(), _pad(0.08, 0.0999, 0.04, 0.0002)], "overlap"),
        ([ring(), _pad(0.08, 0.08, 0.04, 0.04)], "overlap"),
        ([ring(inner=0.00999999)], "ring at .* needs more than 2000 edges around it; use a longer"),
    ],
)
def test_rings_that_cannot_be_placed(footprints, message):
    with pytest.raises(ValueError, match=message):
        triangulate(SQUARE, footprints, 0.02)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ring(inner=0.01, outer=0.01), "radii are 0.01 and 0.01 m; give 0 < inner < outer"),
        (lambda: ring(inner_segments=5), "segments is 5; give 6 to 12 times a power of two"),
        (lambda: ring(x=np.nan), "position is"),
        (lambda: je.skin.RingPatch((0, 0), 0.0, 0.01), "inner_radius is 0.0; give a positive number"),
        (lambda: je.skin.RingPatch((0, 0), 0.02, 0.01), "inner radius is 0.02 m and its outer radius 0.01 m; give an"),
        (lambda: je.skin.RingPatch((0, 0), 0.01, 0.02, -1.0), "contact is -1.0 ohm m.2; give zero"),
    ],
)
def test_bad_rings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def model_of(electrodes, **fidelity):
    skin = skin_of(SQUARE, electrodes, PATTERN)
    return je.discretise(je.Scene(skin), je.Fidelity.draft(solver=Dense(), **fidelity))


@pytest.mark.parametrize("contact", [0.0, 1e-6, 1e-3])
def test_rings_are_reciprocal_and_keep_the_current(contact):
    electrodes = [je.skin.RingPatch(p, 0.004, 0.008, contact) for p in PLACES]
    model = model_of(electrodes)
    readings = np.asarray(je.forward(model))
    assert readings[1] == pytest.approx(readings[2], rel=1e-9)
    assert readings[3] == pytest.approx(readings[4], rel=1e-9)
    if contact:  # the area of a complete electrode is that of the ring
        np.testing.assert_allclose(model.system.measure, np.pi * (0.008**2 - 0.004**2), rtol=1e-9)


def test_the_power_is_that_of_sheet_and_contacts():
    """V I = sum of sigma times dV/dsigma and g times dV/dg: what is driven in is what the parts dissipate."""
    model = model_of([je.skin.RingPatch(p, 0.004, 0.008, 1e-3) for p in PLACES])

    def first(background, contact):
        changed = eqx.tree_at(lambda m: (m.background, m.contact), model, (background, contact))
        return je.forward(changed, background)[0]

    value = first(model.background, model.contact)
    by_sheet, by_contact = jax.grad(first, (0, 1))(model.background, model.contact)
    assert -float(by_sheet @ model.background + by_contact @ model.contact) == pytest.approx(float(value), rel=1e-8)


def test_a_ring_with_a_small_hole_is_a_disc():
    """The readings approach those of an `AreaPatch` of the same outer radius as the hole closes.

    Its own resistance, too: the transfer length is a third of the radius, so that little current misses the hole."""
    bolts = [je.AreaPatch(p, 0.01, 1e-5) for p in PLACES]
    fine = {"order": 2, "electrode_segments": 16}
    expected = np.asarray(je.forward(model_of(bolts, **fine)))
    error = []
    for hole in (0.5, 0.25, 0.1):
        rings = [je.skin.RingPatch(p, hole * 0.01, 0.01, 1e-5) for p in PLACES]
        error.append(np.abs(np.asarray(je.forward(model_of(rings, **fine))) / expected - 1).max())
    assert error[0] > 3 * error[1] > 9 * error[2]
    assert error[2] < 2e-3


RINGS = """kind = "ring"
inner_radius = 0.003
outer_radius = 0.006
contact = 1e-4
positions = [[0.05, 0.05], [0.15, 0.05], [0.15, 0.15], [0.05, 0.15]]"""


def test_a_skin_file_with_rings_is_simulated():
    skin = je.skin.parse_skin(_with_electrodes(RINGS))
    assert [type(e) for e in skin.electrodes] == [je.skin.RingPatch] * 4
    np.testing.assert_allclose(skin.electrode_positions[2], [0.15, 0.15])
    model = je.discretise(je.Scene(skin), je.Fidelity.draft(solver=Dense()))
    before = je.forward(model)
    pressed = je.forward(model, jnp.where(jnp.arange(len(model.areas)) % 7 == 0, 1.1, 1.0) * model.background)
    assert bool(jnp.isfinite(pressed).all())
    assert float(jnp.abs(pressed - before).max()) > 0


def test_pictures_show_a_ring_with_its_hole():
    outer, hole = je.skin.RingPatch((0.05, 0.06), 0.003, 0.006).drawing(SQUARE).outlines
    for outline, radius in ((outer, 0.006), (hole, 0.003)):
        assert np.ptp(outline, axis=0) == pytest.approx(2 * radius, rel=2e-3)
        assert outline.mean(0) == pytest.approx([0.05, 0.06])
    assert je.AreaPatch((0.05, 0.06), 0.003).drawing(SQUARE) == je.skin.ElectrodeDrawing()  # a mark at its centre


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "outer_radius = 0.006",
            "outer_radius = 0.002",
            r"\[electrodes\]: outer_radius: is 0.002 m, not above the inner",
        ),
        ("inner_radius = 0.003", "", "inner_radius: missing; give the radius of the hole in m, above zero"),
        ("inner_radius = 0.003", "inner = 0.003", "inner_radius: missing"),
        ("[0.15, 0.05]", "[0.25, 0.05]", "electrode 1 at .* outside the sheet, which .* to .0.2, 0.2. m; give"),
        ('kind = "ring"', 'kind = "rings"', "kind: no electrode 'rings'; did you mean 'ring'"),
        ('kind = "ring"', 'kind = "mine:Ring"', "kind: electrode 'mine:Ring' is code outside jaxeit"),
        ('kind = "ring"', "", r'kind: missing; give one of .*"ring"'),
    ],
)
def test_wrong_rings_in_a_skin_file(old, new, message):
    assert old in RINGS
    with pytest.raises(je.toml.TomlError, match=message):
        je.skin.parse_skin(_with_electrodes(RINGS.replace(old, new, 1)))
