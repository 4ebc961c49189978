"""Sheets bent in space."""

from dataclasses import replace

import numpy as np
import pytest

import jaxeit as je
from jaxeit.toml import TomlError

from ..helpers import skin_of

POINTS = [(-0.04, -0.02), (0.05, 0.01), (0.0, 0.05), (-0.03, 0.03)]
PATTERN = [[0, 1, 2, 3], [0, 2, 1, 3]]


@pytest.fixture(scope="module")
def chest():
    return je.load_skin("chest")


def test_the_chest(chest):
    assert len(chest.electrodes) == 32
    assert chest.protocol.readings == 32 * 29
    assert chest.protocol.frame_time == pytest.approx(9.28e-3)
    steps = np.linalg.norm(np.diff(chest.electrode_positions, axis=0), axis=1)
    assert steps.max() < 0.07


@pytest.mark.slow
def test_a_rolled_sheet_reads_as_the_flat_one(chest):
    """A cylinder is developable; the mesh's chords are shorter than the arcs by (h / r)^2 / 24."""
    fidelity = je.Fidelity.draft(solver=je.linalg.Dense())
    rolled = je.discretise(je.Scene(chest), fidelity)
    flat = je.discretise(je.Scene(replace(chest, surface=None)), fidelity)
    assert rolled.nodes.shape[1] == 3
    bent, straight = np.asarray(je.forward(rolled)), np.asarray(je.forward(flat))
    assert np.abs(bent - straight).max() < 1e-3 * np.abs(straight).max()
    assert np.abs(bent - straight).max() > 0
    assert float(rolled.areas.sum()) == pytest.approx(0.28**2, rel=1e-3)


@pytest.mark.slow
def test_images_and_forces_on_the_chest(chest):
    model = je.discretise(je.Scene(chest), je.Fidelity.draft(solver=je.linalg.Dense()))
    recon = je.prepare(model, basis=je.Pixels(20))
    near = np.linalg.norm(np.asarray(model.centroids) - [0.08, 0.20], axis=1) < 0.015
    dv = je.forward(model, model.background * (1 + 0.5 * near)) - je.forward(model)
    image = recon(dv)
    found = np.asarray(je.LevelCentroid(0.5)(image, recon))
    assert np.linalg.norm(found - [0.08, 0.20]) < 0.01
    fmap = je.fuse(image, je.pad_masks(chest, recon), np.array([0.0, 0.0, 9.0, 0.0]))
    assert bool(fmap.valid[2])
    assert float(fmap.force.sum()) == pytest.approx(9.0, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("edge_length", [0.08, 0.04])
def test_a_spherical_cap_is_the_flat_disc_of_its_stereographic_projection(edge_length):
    """Conduction in a sheet is invariant under conformal maps, and this projection is conformal."""
    disc = je.Disc(0.1)
    skin = skin_of(disc, [je.PointElectrode(p) for p in POINTS], PATTERN)
    fidelity = je.Fidelity(edge_length=edge_length, solver=je.linalg.Dense())
    mesh = je.model.make_mesh(je.Scene(skin), fidelity)

    def onto_the_sphere(chart, radius=0.08):
        square = np.sum(chart**2, 1, keepdims=True) / (4 * radius**2)
        return np.concatenate([chart, radius * (1 - square)], 1) / (1 + square)

    cap = mesh.lift(onto_the_sphere)
    assert cap.areas.max() < 0.999 * mesh.areas.max()  # far from an isometry
    flat, bent = (np.asarray(je.forward(je.discretise(je.Scene(skin), fidelity, mesh=m))) for m in (mesh, cap))
    np.testing.assert_allclose(bent, flat, rtol=1.5 * edge_length**2)


@pytest.mark.slow
def test_a_sphere_of_large_radius_is_flat():
    disc = je.Disc(0.1)
    skin = skin_of(disc, [je.PointElectrode(p) for p in POINTS], PATTERN)
    fidelity = je.Fidelity(edge_length=0.1, solver=je.linalg.Dense())
    flat, far, near = (
        np.asarray(je.forward(je.discretise(je.Scene(replace(skin, surface=s)), fidelity)))
        for s in (None, je.Sphere(100.0), je.Sphere(0.1))
    )
    np.testing.assert_allclose(far, flat, rtol=1e-5)
    assert np.abs(near / flat - 1).max() > 0.01


def test_surfaces_that_cannot_be():
    with pytest.raises(ValueError, match="above zero"):
        je.Cylinder(0.0)
    with pytest.raises(ValueError, match="larger radius"):
        je.Sphere(0.01)(np.array([[0.1, 0.0]]))


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        (
            je.Cylinder(0.012, 0.1),
            r"reaches 100 mm from x = 0.1 m, .* half a round is 37.7 mm at radius 0.012 m; give a larger",
        ),
        (je.Cylinder(0.05), "reaches 200 mm from x = 0 m, .* give a larger radius, and the middle of the sheet"),
        (je.Sphere(0.04, (0.1, 0.1)), "203 degrees around a sphere"),
    ],
)
def test_a_sheet_over_itself_is_refused_when_the_skin_is_made(skin, surface, message):
    with pytest.raises(je.geometry.SurfaceError, match=message):
        replace(skin, surface=surface)


def test_a_file_of_a_sheet_over_itself_is_refused(chest):
    with pytest.raises(TomlError, match=r"^mine: \[sheet\]: \[surface\]: radius: the sheet reaches 140 mm from"):
        je.skin.parse_skin(chest.toml.replace("radius = 0.3 }", "radius = 0.03 }"), "mine")


def test_a_sheet_once_around_a_cylinder_is_a_skin(skin):
    assert replace(skin, surface=je.Cylinder(0.1 / np.pi, 0.1)).surface.radius == 0.1 / np.pi


@pytest.mark.parametrize("surface", [je.geometry.Plane(), je.Cylinder(0.3, 0.14), je.Sphere(0.2, (0.1, 0.05))])
def test_points_above_a_surface_are_found_on_the_sheet(surface):
    """Normals by differences of the map, and the points above them."""
    chart = np.vstack([np.random.default_rng(0).uniform(-0.1, 0.3, (20, 2)), [[0.1, 0.05]]])
    at, step = surface(chart), 1e-6
    along = [(surface(chart + step * e) - surface(chart - step * e)) / (2 * step) for e in np.eye(2)]
    normal = np.cross(*along)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.linspace(-0.01, 0.02, len(chart))
    found = surface.project(at + height[:, None] * normal)
    np.testing.assert_allclose(found.chart, chart, atol=1e-12)
    np.testing.assert_allclose(found.height, height, atol=1e-12)
    np.testing.assert_allclose(found.normal, normal, atol=1e-8)


def test_a_surface_of_ones_own_says_what_the_reverse_needs():
    class Ramp(je.geometry.AbstractSurface):
        def __call__(self, chart):
            return np.column_stack([chart, chart[:, 0]])

    with pytest.raises(je.geometry.SurfaceError, match="Ramp maps to space only; define its method project"):
        Ramp().project(np.zeros((1, 3)))
