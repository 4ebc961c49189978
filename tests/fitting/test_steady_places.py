"""Places of presses without the errors of single images, and what these errors do to a field."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from calib.fitting.cross_validation.neighbourhoods import with_error_scale
from calib.fitting.curves import Linear
from calib.fitting.fields import PadEdge, PadEdgeSpline, Places, geometry_of, single_places
from calib.fitting.fields.steady_places import MIN_PRESSES, steady_places
from calib.fitting.losses import SoftL1
from calib.fitting.response import fit_response, fold_presses, hold_out_response

from ..helpers import require_identical
from .test_intervals import pressed

LINES = np.linspace(0.01, 0.19, 12)
GRID = np.stack(np.meshgrid(LINES, LINES), -1).reshape(-1, 2)
ERROR = 0.8e-3  # m, of a coordinate of a place by an image


def seen(stage, rng, error=ERROR):
    """Places of images, which err inwards by 1 mm at the rim of the sheet, and at random."""
    inwards = 1e-3 * (np.exp(-stage / 0.015) - np.exp(-(0.2 - stage) / 0.015))
    return stage + inwards + error * rng.normal(size=stage.shape), stage + inwards


def test_places_on_a_line_are_at_one_distance_where_images_show_them_on_average(skin):
    """Also where a single image errs by far."""
    image, average = seen(GRID, np.random.default_rng(1))
    image[7] += 0.02
    found = steady_places(geometry_of(skin), single_places(image, 4, width=0.01), GRID)
    place = np.asarray(found.position)[:, 0]
    assert np.abs(place - average).max() < 0.4 * ERROR  # of 144 presses; a side's place is that of 48 errors
    from_wall = np.minimum(place, 0.2 - place)
    for line in LINES[:6]:
        ours = np.abs(np.minimum(GRID, 0.2 - GRID) - line) < 1e-6
        assert np.std(from_wall[ours]) < 0.1 * ERROR
    np.testing.assert_array_equal(found.width, np.full((144, 1), 0.01))


def test_places_are_the_work_of_one_program_that_sessions_share(skin, compilations):
    """Each operation by itself is a program, too: fifty of them took as long to compile as the fit."""
    geometry = geometry_of(skin)
    for count, programs in ((120, 1), (117, 0)):  # presses, of which no other test has as many
        places = single_places(GRID[:count], 4)
        compilations.clear()
        assert steady_places(geometry, places, GRID[:count]) is not None
        assert compilations.count("/jax/core/compile/backend_compile_duration") == programs


def test_exact_places_stay(skin):
    found = steady_places(geometry_of(skin), single_places(GRID, 4), GRID)
    np.testing.assert_allclose(found.position[:, 0], GRID, atol=1e-9)


def test_a_stage_that_is_off_as_a_whole_is_followed_to_where_the_images_are(skin):
    image, average = seen(GRID, np.random.default_rng(2))
    off = np.array([2e-3, -1e-3])
    found = steady_places(geometry_of(skin), single_places(image + off, 4), GRID)
    assert np.abs(np.asarray(found.position)[:, 0] - average - off).max() < 0.5 * ERROR


def test_images_that_err_by_millimetres_or_few_presses_tell_no_average(skin):
    geometry, rng = geometry_of(skin), np.random.default_rng(3)
    assert steady_places(geometry, single_places(seen(GRID, rng, 4e-3)[0], 4), GRID) is None
    few = GRID[: MIN_PRESSES - 1]
    assert steady_places(geometry, single_places(few, 4), few) is None
    unknown = np.full_like(GRID, np.nan)
    assert steady_places(geometry, single_places(GRID, 4), unknown) is None
    assert steady_places(geometry, single_places(unknown, 4), GRID) is None


def test_presses_of_several_contacts_or_of_no_known_place_keep_those_of_the_image(skin):
    image, _ = seen(GRID, np.random.default_rng(4))
    position = np.stack([image, np.full_like(image, np.nan)], 1)
    position[5, 1] = 0.05, 0.12
    stage = np.where(np.arange(144)[:, None] == 9, np.nan, GRID)
    weight = np.repeat(np.isfinite(position).all(-1)[..., None], 4, -1) * 1.0
    places = Places(*map(jnp.asarray, (position, weight, np.full((144, 2), 0.01), np.ones((144, 2)))))
    found = np.asarray(steady_places(geometry_of(skin), places, stage).position)
    require_identical(found[[5, 9]], position[[5, 9]])
    assert (found[:5, 0] != position[:5, 0]).any(1).all()


def test_only_a_field_that_asks_for_it_is_fitted_to_average_places(skin):
    rng = np.random.default_rng(6)
    data, image = pressed(skin, GRID, rng, 0.4, 0.01, 0.012), single_places(seen(GRID, rng)[0], 4)
    presses = fold_presses(skin, data, image, SoftL1(), 5, GRID).presses
    assert presses.of(PadEdge()) is presses.of(None) is image
    assert presses.of(PadEdgeSpline()) is presses.steady is not None
    assert fold_presses(skin, data, image, SoftL1(), 5).presses.of(PadEdgeSpline()) is image


def test_a_round_sheet_has_averages_too(skin):
    rng = np.random.default_rng(5)
    angle, radius = rng.uniform(0, 2 * np.pi, 200), 0.09 * np.sqrt(rng.uniform(0, 1, 200))
    stage = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    pad = je.Pad("all", np.array([[-0.07, -0.07], [0.07, -0.07], [0.07, 0.07], [-0.07, 0.07]]))
    disc = je.Skin("round", je.Disc(0.1), 1.0, skin.electrodes, skin.protocol, (pad,))
    image = stage * (1 - 0.02 * np.exp(-(0.1 - radius) / 0.015))[:, None]
    found = steady_places(geometry_of(disc), single_places(image + ERROR * rng.normal(size=(200, 2)), 1), stage)
    left = np.linalg.norm(np.asarray(found.position)[:, 0] - image, axis=1)
    assert np.sqrt(np.mean(left**2)) < 0.5 * ERROR


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_forces_between_the_lines_of_a_grid_do_not_show_the_errors_of_single_places(skin, seed):
    """Places of one line that seem to lie at several distances flatten a field there, and lift it between the lines."""
    rng = np.random.default_rng([17, seed])
    pads = 0.4, 0.01, 0.012
    data, sites = pressed(skin, GRID, rng, *pads), rng.uniform(0.012, 0.188, (300, 2))
    away = np.min([je.Polygon(pad.outline).boundary_distance(sites) for pad in skin.pads], 0)
    sites = sites[(away > 0.013) & (away < 0.019)]
    new, (image, _) = pressed(skin, sites, rng, *pads), seen(sites, rng)
    at, known = single_places(image, 4), single_places(seen(GRID, rng)[0], 4)
    bias, covered = [], []
    for stage in (None, GRID):
        folds = fold_presses(skin, data, known, SoftL1(), 5, stage)
        response = fit_response(folds, skin, (Linear(),), (PadEdgeSpline(),))
        found = hold_out_response(folds, response, {}, data.force)
        model = replace(response.model, noise=found.noise, hold_noise=found.hold_noise)
        force, half = with_error_scale(model, found.error_scale).hold_forces(new.pressure, at)
        error = force.sum(1) - new.force
        bias.append(np.mean(error / new.force))
        covered.append(np.mean(np.abs(error) <= half))
    assert abs(bias[1]) < 0.02 < 0.06 < bias[0]
    assert covered[0] < 0.5
    assert covered[1] > 0.75  # places of one skin err alike
