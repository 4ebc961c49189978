"""What contacts show, against the full forward map and against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.contacts.loads.spreading import Spreading
from jaxeit.imaging.readings.whitening import whitened_readings
from jaxeit.model.bases import Elements
from jaxeit.model.sensitivity import pair_jacobian
from jaxeit.tracking import prepare_tracker
from jaxeit.tracking.belief.reanalysis import prepare_reanalysis
from jaxeit.tracking.belief.response import load_pressure, load_slopes
from jaxeit.tracking.preparation import squared_line_distances
from tests.compiled import compiled

from .conftest import GAUSSIAN, in_double_precision

LOADS = jnp.array([[0.07, 0.09, np.log(0.012), np.log(15.0), 0, 0], [0.1, 0.1, np.log(0.01), np.log(8.0), 6e-3, 3e-3]])

SQUARE = """
format = "jaxeit-skin"
version = 1
name = "square"
sheet = {{shape = "rectangle", size = [{side}, {side}], sheet_resistance = 150.0}}
electrodes = {{kind = "bolt", radius = 0.003, contact = 1e-6, positions = {grid}}}
protocol = {{pattern = "adjacent", current = 1e-3, reading_time = 1e-5}}
pressure_sensor = {{maximum = 34474.0, accuracy = 86.0}}
pads = [{{name = "all", rectangle = [0.0, 0.0, {side}, {side}]}}]
"""


@pytest.fixture(scope="module")
def whitened(model, blank):
    return whitened_readings(model, blank[1], None)


@pytest.fixture(scope="module")
def sheet(model, whitened):
    return prepare_reanalysis(model, model.background, whitened.electrodes, whitened.factor, np.dtype(float))


@pytest.fixture(scope="module")
def touched(model):
    """Change of conductivity, S, and the elements that change, the most first."""
    pressure = sum(load_pressure(load, model.centroids, GAUSSIAN) for load in LOADS)
    change = model.background * pressure / (20e3 + pressure)
    return change, jnp.argsort(-change)


def _all_unknowns(sheet):
    return jnp.arange(len(sheet.green))


@pytest.fixture(scope="module")
def first_order(model, whitened):
    """Readings per change of each element, to first order."""
    image, mixing = Elements().on(model), jnp.asarray(whitened.factor)
    return pair_jacobian(model, model.background, image, jnp.asarray(whitened.electrodes), mixing)


def test_with_all_unknowns_reanalysis_is_the_forward_map(model, whitened, sheet, touched, first_order):
    change, elements = touched
    found = compiled(sheet.nonlinear_part, elements, _all_unknowns(sheet), change[elements])
    moved = je.forward(model, model.background + change) - je.forward(model, model.background)
    exact = whitened.compress @ whitened.whitening.sums(moved)
    assert jnp.linalg.norm(exact) > 500
    np.testing.assert_allclose(found.readings + first_order @ change, exact, atol=1e-6)


def test_slopes_along_a_coat_are_those_of_the_forward_map(model, whitened, sheet, touched):
    change, elements = touched
    after = compiled(sheet.potential_after, elements, _all_unknowns(sheet), change[elements])
    along = model.background * jnp.sin(30 * model.centroids).T

    def readings(sigma):
        return whitened.compress @ whitened.whitening.sums(je.forward(model, sigma))

    pressed = model.background + change
    wanted = (readings(pressed + 1e-5 * along[0]) - readings(pressed - 1e-5 * along[0])) / 2e-5
    np.testing.assert_allclose(
        compiled(sheet.slopes_along, along, after)[0], wanted, atol=1e-6 * float(jnp.linalg.norm(wanted))
    )


def test_fewer_unknowns_err_less_than_noise(sheet, touched):
    change, elements = touched
    every = compiled(sheet.nonlinear_part, elements, _all_unknowns(sheet), change[elements]).readings
    around = jnp.zeros(len(sheet.green)).at[sheet.dofs].max(change[:, None])
    errors = []
    for size in (48, 96, 192):
        chosen = jax.lax.top_k(around, size)[1]
        errors.append(
            float(jnp.linalg.norm(compiled(sheet.nonlinear_part, elements, chosen, change[elements]).readings - every))
        )
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1 < jnp.linalg.norm(every)


def test_what_occurs_twice_counts_once(sheet, touched):
    change, elements = touched
    few, unknowns = elements[:150], jnp.unique(sheet.dofs[elements[:150]])
    once = compiled(sheet.nonlinear_part, few, unknowns, change[few]).readings
    both, twice = jnp.concatenate([few, few[:40]]), jnp.concatenate([unknowns, unknowns[:30]])
    again = compiled(sheet.nonlinear_part, both, twice, jnp.concatenate([change[few], jnp.zeros(40)])).readings
    np.testing.assert_allclose(again, once, atol=1e-8)


def test_slopes_of_reanalysis_are_differences(sheet, touched):
    change, elements = touched
    few = elements[:150]
    unknowns, size = jnp.unique(sheet.dofs[few]), 1e-5
    direction = jnp.sin(jnp.arange(150.0)) * change[few]
    sides = [
        compiled(sheet.nonlinear_part, few, unknowns, change[few] + s * size * direction).readings for s in (1, -1)
    ]
    found = compiled(sheet.nonlinear_part, few, unknowns, change[few])
    slope = compiled(sheet.nonlinear_slopes, found, direction[None])[0]
    np.testing.assert_allclose(slope, (sides[0] - sides[1]) / (2 * size), atol=1e-6 * float(jnp.linalg.norm(slope)))


@pytest.fixture(scope="module")
def exact(tracker):
    """The tracker's sheet in double precision."""
    return in_double_precision(tracker.filter.sheet)


def test_what_contacts_show_has_the_slopes_of_differences(exact):
    """Place, width, force, length and gain; forces on pads too."""
    modes = jnp.array([0, 40, 77])
    gain = 0.3 * jnp.cos(jnp.arange(exact.modes.shape[1], dtype=float))
    near = exact.neighbourhood(LOADS)

    @jax.jit
    def shown(numbers):
        found = exact.predict_measurement(numbers[:12].reshape(2, 6), gain.at[modes].add(numbers[12:]), modes, near)
        return jnp.concatenate([found.readings, found.pads]), found

    start = jnp.concatenate([LOADS.ravel(), jnp.zeros(3)])
    found = shown(start)[1]
    slopes = jnp.concatenate([found.reading_slopes, found.pad_slopes], 1)
    for k in range(len(start)):
        step = jnp.zeros(len(start)).at[k].set(1e-5 if k in (0, 1, 4, 5, 6, 7, 10, 11) else 1e-4)
        near, far = (shown(start + m * step)[0] - shown(start - m * step)[0] for m in (1, 2))
        difference = (8 * near - far) / (12 * step[k])  # of fourth order: steps may be long, and rounding stays small
        np.testing.assert_allclose(slopes[k], difference, atol=2e-5 * float(jnp.linalg.norm(difference)) + 1e-6)


def test_what_contacts_show_is_near_the_full_forward_map(model, tracker, blank, exact):
    """The tails of the second order are left out, and an image stands for the first."""
    pressure = sum(load_pressure(load, model.centroids, GAUSSIAN) for load in LOADS)
    v = je.forward(model, model.background * (1 + pressure / (20e3 + pressure)))
    wanted = tracker.filter.compress @ (v - blank[0])
    gain = jnp.zeros(exact.modes.shape[1])
    found = compiled(exact.predict_measurement, LOADS, gain, jnp.array([0]), exact.neighbourhood(LOADS)).readings
    assert jnp.linalg.norm(found - wanted) < 0.02 * jnp.linalg.norm(wanted)


def test_distances_from_loads_are_those_from_their_lines():
    rng = np.random.default_rng(0)
    middles, places = rng.uniform(0, 0.2, (2, 20, 2))
    halves = np.array([[0, 0], [0.01, 0.02], [-0.03, 0]])
    lines = middles[:, None] + np.linspace(-1, 1, 2001)[:, None] * halves[:, None, None]  # (edges, n, points, 2)
    sampled = np.linalg.norm(lines[:, :, None] - places[:, None], axis=-1).min(-1)
    np.testing.assert_allclose(np.sqrt(squared_line_distances(middles, places, halves)), sampled, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("side", [0.08, 0.12, 0.3])
def test_a_contact_is_as_wide_on_a_small_sheet(side):
    """An image of as many pixels on every sheet would leave out the tails of a load on a small one."""
    grid = [[x * side, y * side] for x in (0.2, 0.5, 0.8) for y in (0.2, 0.5, 0.8)]
    skin = je.skin.parse_skin(SQUARE.format(side=side, grid=grid))
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    noise = jnp.full(54, 1e-3 * jnp.sqrt(jnp.mean(je.forward(model) ** 2)))
    small = prepare_tracker(model, skin, noise=noise, sigma=model.background)
    pressed = jnp.array([[0.45 * side, 0.4 * side, np.log(0.012), np.log(1.0), 0, 0]])
    pressure = load_pressure(pressed[0], model.centroids, GAUSSIAN)
    v = je.forward(model, model.background * (1 + pressure / (20e3 + pressure)))
    wanted = small.filter.compress @ (v - je.forward(model))
    sheet = small.filter.sheet
    found = sheet.predict_measurement(
        pressed, jnp.zeros(sheet.modes.shape[1]), jnp.array([0]), sheet.neighbourhood(pressed)
    ).readings
    assert jnp.linalg.norm(found - wanted) < 0.02 * jnp.linalg.norm(wanted)


@pytest.mark.slow
def test_single_precision_errs_below_a_tenth_of_the_noise(tracker, exact):
    gain = jnp.zeros(exact.modes.shape[1])
    single = compiled(
        tracker.filter.sheet.predict_measurement, LOADS, gain, jnp.array([0]), exact.neighbourhood(LOADS)
    ).readings
    double = compiled(exact.predict_measurement, LOADS, gain, jnp.array([0]), exact.neighbourhood(LOADS)).readings
    assert single.dtype == double.dtype
    assert jnp.max(jnp.abs(single - double)) < 0.1


@pytest.mark.parametrize("depth", [0.0, 0.01, 0.02])
@pytest.mark.parametrize("half", [(0.0, 0.0), (1e-3, 0.0), (6e-3, 3e-3), (-0.02, 0.03)])
def test_slopes_of_a_load_by_hand_are_those_of_jax(half, depth):
    """At a depth of 20 mm the load is narrower than a point load becomes."""
    spreading = Spreading.at_depth(depth, float)
    points = jnp.asarray(np.random.default_rng(0).uniform(0.07, 0.13, (200, 2)))
    load = jnp.array([0.1, 0.1, np.log(0.01), np.log(8.0), *half])
    value, slopes = load_slopes(load, points, spreading)
    expected = jax.jacfwd(load_pressure)(load, points, spreading).T
    size = jnp.abs(expected).max(1)
    np.testing.assert_allclose(value, load_pressure(load, points, spreading), rtol=1e-12)
    np.testing.assert_array_less(jnp.abs(slopes - expected).max(1), 1e-9 * size + 1e-300)


def test_a_load_on_a_pad_is_felt_by_it(tracker):
    """The pads of the testbed cover its quarters, but for gaps."""
    sheet = tracker.filter.sheet
    load = jnp.array([[0.05, 0.05, np.log(0.008), np.log(10.0), 0, 0]])
    found = compiled(
        sheet.predict_measurement, load, jnp.zeros(sheet.modes.shape[1]), jnp.array([0]), sheet.neighbourhood(load)
    )
    np.testing.assert_allclose(sorted(found.pads), [0, 0, 0, 10], atol=0.3)


def test_an_edge_of_length_zero_is_a_round_load():
    points = jnp.stack(jnp.meshgrid(jnp.linspace(0, 0.2, 41), jnp.linspace(0, 0.2, 41)), -1)
    load = LOADS[0]
    square = jnp.sum((points - load[:2]) ** 2, -1)
    width, force = jnp.exp(load[2]), jnp.exp(load[3])
    gaussian = force * jnp.exp(-0.5 * square / width**2) / (2 * jnp.pi * width**2)
    np.testing.assert_allclose(load_pressure(load, points, GAUSSIAN), gaussian, atol=1e-4 * float(gaussian.max()))
    assert jnp.isclose(load_pressure(LOADS[1], points, GAUSSIAN).sum() * 0.005**2, 8, rtol=1e-3)
