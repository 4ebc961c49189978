"""Designs of scans: sensitivities against the forward map, designs against all subsets, and what the testbed gains."""

from collections import Counter
from dataclasses import replace
from itertools import combinations, product

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.registry import SettingError
from jaxeit.scan import CRITERIA, DesignSettings, PlaceError, PlaceVolume, design_scan, place_sensitivity

from ..helpers import square_model

POINTS = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15), (0.1, 0.1), (0.1, 0.0)]
EVERY = je.skin.all_pairs(6)
A_OPTIMAL = PlaceError(2.0)
SETTINGS = DesignSettings(columns=2, noise=1e-5, width=0.04, model_error=0.0)


@pytest.fixture(scope="module")
def small():
    """All readings of six electrodes."""
    return square_model(POINTS, EVERY, 8)


@pytest.fixture(scope="module")
def sensitivity(small):
    return place_sensitivity(small, SETTINGS)


@pytest.fixture(scope="module")
def testbed(model):
    return place_sensitivity(model, DesignSettings(columns=4))


def _bump_means(model, x, y, log_strength, log_width):
    """Conductivity under a contact, the bump averaged over each element at many points."""
    inside = np.array([(i + 1 / 3, j + 1 / 3) for i in range(12) for j in range(12 - i)])
    inside = np.concatenate([inside, [(i + 2 / 3, j + 2 / 3) for i in range(12) for j in range(11 - i)]]) / 12
    weights = np.concatenate([inside, 1 - inside.sum(1, keepdims=True)], 1)
    points = np.einsum("qk,ekd->eqd", weights, np.asarray(model.nodes)[np.asarray(model.triangles)][..., :2])
    square = (points[..., 0] - x) ** 2 + (points[..., 1] - y) ** 2
    bump = np.exp(log_strength - 0.5 * square / np.exp(2 * log_width)).mean(1)
    return model.background * (1 + SETTINGS.strength * 1e-4 * bump)  # small: the map is linear there


def test_sensitivities_are_slopes_of_the_forward_map(small, sensitivity):
    found = np.asarray(sensitivity.rows(EVERY))
    assert found.shape == (4, 4, 45)
    site, width = np.asarray(sensitivity.sites)[1], SETTINGS.width
    centre, steps = np.array([*site, 0.0, np.log(width)]), np.array([1e-3 * width, 1e-3 * width, 1e-3, 1e-3])
    for unknown, step in enumerate(np.diag(steps)):
        ahead, back = (np.asarray(je.forward(small, _bump_means(small, *(centre + s * step)))) for s in (1, -1))
        slope = (ahead - back) / (2e-3 * 1e-4 * SETTINGS.noise)
        np.testing.assert_allclose(found[1, unknown], slope, atol=5e-3 * np.abs(slope).max())
    np.testing.assert_allclose(sensitivity.voltages(EVERY), je.forward(small), rtol=1e-9, atol=1e-14)  # some are zero


def _covariances(sensitivity, rows):
    """Covariance of place in squared widths at each site, the rest marginalised, of subsets (..., 4, readings)."""
    information = rows @ rows.swapaxes(-1, -2) + np.diag(np.asarray(sensitivity.prior))
    return np.linalg.inv(information)[..., :2, :2]


def test_errors_are_those_of_the_inverse_information(sensitivity):
    pattern = EVERY[[3, 8, 20, 31, 40]]
    place = _covariances(sensitivity, np.asarray(sensitivity.rows(pattern)))
    expected = SETTINGS.width * np.sqrt(np.trace(place, axis1=-2, axis2=-1))
    np.testing.assert_allclose(sensitivity.errors(pattern), expected, rtol=1e-8)
    alive = pattern[(pattern != 2).all(1)]
    assert 0 < len(alive) < len(pattern)
    np.testing.assert_allclose(sensitivity.errors(pattern, 2), sensitivity.errors(alive), rtol=1e-8)
    dead = [float(jnp.sqrt(jnp.mean(sensitivity.errors(pattern, e) ** 2))) for e in range(6)]
    assert sensitivity.worst_dead(pattern) == (int(np.argmax(dead)), pytest.approx(max(dead)))


FIGURES = {
    "place-error": lambda place: np.sqrt(np.trace(place, axis1=-2, axis2=-1)).mean(-1),
    "place-error:power=6": lambda place: (np.trace(place, axis1=-2, axis2=-1) ** 3).mean(-1) ** (1 / 6),
    "d-optimal": lambda place: np.sqrt(2) * np.exp(0.25 * np.log(np.linalg.det(place)).mean(-1)),
}


@pytest.mark.parametrize("name", FIGURES)
def test_a_design_is_near_the_best_of_all_subsets_and_its_bound_holds(sensitivity, name):
    candidates = EVERY[::2]
    rows = np.asarray(sensitivity.rows(candidates))
    subsets = np.array_split(np.array(list(combinations(range(23), 5))), 10)
    place = np.concatenate([_covariances(sensitivity, rows[:, :, part].transpose(2, 0, 1, 3)) for part in subsets])
    best = SETTINGS.width * FIGURES[name](place).min()
    found = design_scan(sensitivity, 5, CRITERIA.make(name), candidates=candidates)
    own = SETTINGS.width * FIGURES[name](_covariances(sensitivity, np.asarray(sensitivity.rows(found.pattern))))
    assert found.error == pytest.approx(own, rel=1e-6)
    assert found.bound <= best * (1 + 1e-9) <= found.error * (1 + 1e-6)
    assert found.error < 1.05 * best


def _least_time(pattern, channels, switch):
    """The least time of a frame, over all ways in which each reading is driven by one of its two pairs."""
    ends = [[tuple(sorted(row[:2])), tuple(sorted(row[2:]))] for row in pattern.tolist()]
    counts = (Counter(drives) for drives in product(*ends))
    return min(sum(-(-n // channels) + switch for n in count.values()) for count in counts)


@pytest.mark.parametrize(("time", "channels", "switch"), [(2, 2, 0.0), (2, 3, 0.0), (3, 2, 0.0), (5, 2, 1.5)])
def test_a_design_with_sense_channels_is_near_the_best_of_all_that_fit(sensitivity, time, channels, switch):
    """All subsets of the readings of five electrodes which so many channels can take in the time, by brute force."""
    candidates = EVERY[(EVERY < 5).all(1)]
    rows = np.asarray(sensitivity.rows(candidates))
    best, most = np.inf, 0
    for size in range(1, int(time - switch) * channels + 1):
        for part in combinations(range(len(candidates)), size):
            if _least_time(candidates[list(part)], channels, switch) <= time:
                place = _covariances(sensitivity, rows[:, :, list(part)])
                best, most = min(best, SETTINGS.width * FIGURES["place-error"](place)), size
    found = design_scan(sensitivity, time, candidates=candidates, sense_channels=channels, switch=switch)
    protocol = je.Protocol(found.pattern, sense_channels=channels)
    own = SETTINGS.width * FIGURES["place-error"](
        _covariances(sensitivity, np.asarray(sensitivity.rows(found.pattern)))
    )
    assert je.scan.scan_time(protocol, switch) <= time * protocol.reading_time * (1 + 1e-9)
    assert len(found.pattern) == most
    assert found.error == pytest.approx(own, rel=1e-6)
    assert best * (1 - 1e-9) <= found.error < 1.06 * best
    if not switch:
        assert found.bound <= best * (1 + 1e-9)


def test_a_design_for_a_dead_electrode_loses_less_without_it(sensitivity):
    whole, careful = (design_scan(sensitivity, 12, A_OPTIMAL, any_dead=dead) for dead in (False, True))
    assert sensitivity.worst_dead(careful.pattern)[1] < sensitivity.worst_dead(whole.pattern)[1]
    assert whole.error <= float(jnp.sqrt(jnp.mean(sensitivity.errors(careful.pattern) ** 2)))
    cases = [sensitivity.errors(careful.pattern, dead) for dead in (None, *range(6))]
    assert careful.error == pytest.approx(float(jnp.sqrt(jnp.mean(jnp.stack(cases) ** 2))), rel=1e-6)
    assert careful.bound <= careful.error


@pytest.mark.slow
def test_a_hundred_readings_tell_more_than_the_whole_adjacent_scan(testbed, skin):
    """Of a seventh of all, which takes less time; each change of drive at the cost of ten readings: few drives."""
    adjacent = testbed.errors(skin.protocol.pattern)
    found = design_scan(testbed, 100, A_OPTIMAL, candidates=je.skin.all_pairs(25)[::7])
    assert found.bound <= found.error < 1.02 * found.bound
    assert found.error < 0.75 * float(jnp.sqrt(jnp.mean(adjacent**2)))
    assert (np.asarray(testbed.voltages(found.pattern)) >= 0).all()
    assert len(np.unique(found.pattern, axis=0)) == 100
    runs = 1 + np.count_nonzero(np.any(np.diff(found.pattern[:, :2], axis=0), axis=1))
    assert runs == found.drives
    slow = design_scan(testbed, 100, switch=10.0, candidates=skin.protocol.pattern)
    assert slow.drives < 10
    assert 80 < len(slow.pattern) + 10 * slow.drives <= 100
    few = je.scan.scan_time(je.Protocol(slow.pattern), 10.0)
    assert few == pytest.approx((len(slow.pattern) + 10 * slow.drives) * 1e-5)


@pytest.mark.slow
def test_many_channels_at_once_lose_little(testbed):
    """Slots of eight readings of one drive each, against the bound of any scan of so many readings."""
    found = design_scan(testbed, 20, candidates=je.skin.all_pairs(25)[::7], sense_channels=8)
    protocol = je.Protocol(found.pattern, sense_channels=8)
    assert (protocol.readings, protocol.slots[-1] + 1) == (160, 20)
    assert found.bound <= found.error < 1.1 * found.bound
    assert len(np.unique(_unordered(found.pattern), axis=0)) == 160


def _unordered(pattern):
    pairs = np.sort(pattern.reshape(-1, 2, 2), 2)
    return np.sort(pairs @ [100, 1], 1)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda s: design_scan(s, 46), "readings is 46, and there are 45 candidates"),
        (lambda s: design_scan(s, 10, switch=-1.0), "switch is -1.0; give"),
        (lambda s: design_scan(s, 10, switch=20.0), "over before one drive has settled"),
        (lambda s: design_scan(s, 10, sense_channels=0), "sense_channels is 0; give how many"),
        (lambda s: PlaceError(0.0), "power is 0; give more than 0 to 40"),
        (lambda s: DesignSettings(width=0.0), "width is 0.0; give a number above 0"),
        (lambda s: DesignSettings(noise=0.0), "noise is 0 V"),
        (lambda s: DesignSettings(relative=-1.0), "relative is -1.0"),
        (lambda s: DesignSettings(columns=0), "columns is 0"),
    ],
)
def test_what_cannot_be_designed(sensitivity, call, said):
    with pytest.raises((je.skin.ProtocolError, SettingError), match=said):
        call(sensitivity)


def test_relative_noise_and_errors_of_the_model_make_large_readings_worth_less(small, sensitivity):
    noisy = place_sensitivity(small, replace(SETTINGS, relative=0.1))
    less = 1e-5 / np.hypot(1e-5, 0.1 * np.asarray(sensitivity.voltages(EVERY)))
    expected = less * np.asarray(sensitivity.rows(EVERY))[0, 0]  # some are zero
    np.testing.assert_allclose(noisy.rows(EVERY)[0, 0], expected, rtol=1e-9, atol=1e-9)
    assert isinstance(CRITERIA.make("d-optimal"), PlaceVolume)
    wrong = np.asarray(place_sensitivity(small, replace(SETTINGS, model_error=0.03)).rows(EVERY))
    signal = np.asarray(sensitivity.rows(EVERY))[:, 2:3]
    np.testing.assert_allclose(wrong * np.hypot(1, 0.03 * signal), sensitivity.rows(EVERY), rtol=1e-9, atol=1e-9)
