"""Fewer readings a frame: against brute force over subsets, determinants computed anew, and SciPy's pivoted QR."""

from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import qr

import jaxeit as je

SELECTIONS = [je.scan.DOptimal(), je.scan.Volume(), je.scan.Sensitive()]


@pytest.fixture(scope="module")
def rows():
    """Sensitivities of twelve readings to nine coefficients, some alike, some faint."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=(12, 9)) * np.array([3, 3, 1, 1, 1, 0.3, 0.3, 2, 2, 2, 1, 0.1])[:, None]
    a[1] = a[0] + 0.01 * a[1]
    return a


@pytest.fixture(scope="module")
def expected(model, pixels):
    return je.scan.signal_covariance(model, basis=pixels)


@pytest.fixture(scope="module")
def scan(model, skin, pixels):
    return je.scan.prepare_event_scan(
        model, skin, je.scan.EventScanSettings(onset=200.0, idle=12, local=30, every=5, radius=0.1), basis=pixels
    )


def told(signal, rows):
    """``log det(1 + K_SS)``."""
    part = np.asarray(signal)[np.ix_(rows, rows)]
    return np.linalg.slogdet(np.eye(len(part)) + part)[1]


def test_the_signal_is_what_the_prior_expects_over_the_noise(model, pixels):
    noise, region = np.linspace(1, 2, 550), np.asarray(je.scan.around(pixels, [0.06, 0.13], 0.03))
    j = np.asarray(je.jacobian(model, None, pixels)) / noise[:, None]
    precision = np.sqrt((j**2).sum(0))
    precision = np.maximum(precision, 1e-3 * precision.max())
    strength = 0.2**2 * np.trace(j / precision @ j.T) / 550
    whole, near = je.scan.signal_covariance(
        model, basis=pixels, noise=noise, hyperparameter=0.2, region=np.stack([region**0, region])
    )
    np.testing.assert_allclose(whole, j / precision @ j.T / strength, atol=1e-9 * np.trace(whole) / 550)
    np.testing.assert_allclose(near, j * (region / precision) @ j.T / strength, atol=1e-9 * np.trace(whole) / 550)


def test_what_readings_tell_is_the_fall_of_the_images_uncertainty(rows):
    """The determinant in data space is that in image space (physics: log det(G^-1 + J_S^T W J_S))."""
    prior = np.diag(np.linspace(0.5, 2, 9))
    for taken in ([0], [3, 5, 8], list(range(12))):
        j = rows[taken]
        image = np.linalg.slogdet(np.linalg.inv(prior) + j.T @ j)[1] + np.linalg.slogdet(prior)[1]
        assert told(rows @ prior @ rows.T, taken) == pytest.approx(image, rel=1e-12)


def test_each_reading_is_the_best_beside_those_taken(rows):
    signal = rows @ rows.T
    chosen = je.scan.choose_readings(jnp.asarray(signal), 12)
    taken: list[int] = []
    for row, gain in zip(chosen.rows.tolist(), chosen.gain, strict=True):
        worth = {r: told(signal, [*taken, r]) - told(signal, taken) for r in range(12) if r not in taken}
        assert max(worth, key=lambda r: worth[r]) == row
        assert float(gain) == pytest.approx(worth[row], rel=1e-9)
        taken.append(row)
    assert (np.diff(chosen.gain) <= 1e-12).all()


@pytest.mark.parametrize("count", [1, 2, 4, 6])
def test_greedy_is_near_the_best_of_all_subsets(rows, count):
    signal = rows @ rows.T
    best = max(told(signal, s) for s in combinations(range(12), count))
    found = told(signal, je.scan.choose_readings(jnp.asarray(signal), count).rows)
    assert (1 - np.exp(-1)) * best <= found <= best * (1 + 1e-12)
    assert found > 0.97 * best  # what it does here; the bound is for the worst case


def test_volume_is_qr_with_pivots(rows):
    _, _, pivots = qr(rows.T, pivoting=True)
    chosen = je.scan.choose_readings(jnp.asarray(rows @ rows.T), 9, je.scan.Volume())
    assert chosen.rows.tolist() == pivots[:9].tolist()
    assert np.prod(chosen.gain) == pytest.approx(np.linalg.det(rows[pivots[:9]]) ** 2)
    with pytest.raises(je.skin.ProtocolError, match="fewer than 10 dimensions"):
        je.scan.choose_readings(jnp.asarray(rows @ rows.T), 10, je.scan.Volume())


def test_sensitive_is_the_largest_sums_of_squares(model, pixels):
    region = np.asarray(je.scan.around(pixels, [0.06, 0.13], 0.02))
    j = np.asarray(je.jacobian(model, None, pixels))
    signal = je.scan.signal_covariance(model, je.Tikhonov(), pixels, region=region)
    found = je.scan.choose_readings(signal, 40, je.scan.Sensitive())
    worth = j**2 @ (region / np.asarray(pixels.areas))
    np.testing.assert_allclose(worth[np.asarray(found.rows)], np.sort(worth)[::-1][:40], rtol=1e-9)


def test_on_the_testbed_d_optimal_tells_more_than_the_others_and_than_chance(expected):
    rng = np.random.default_rng(0)
    told_by = [told(expected, je.scan.choose_readings(expected, 60, s).rows) for s in SELECTIONS]
    chance = [told(expected, rng.choice(550, 60, replace=False)) for _ in range(20)]
    assert told_by[0] >= max(told_by[1:])
    assert told_by[0] > 1.2 * max(chance)


def test_readings_that_share_a_drive_cost_less(skin, expected):
    pattern, protocol = skin.protocol.pattern, skin.protocol
    free = je.scan.choose_readings(expected, 60)
    dear = je.scan.choose_readings(expected, 60, pattern=pattern, switch=50.0)
    changes = [len(np.unique(je.scan.drives(pattern[np.asarray(c.rows)]))) for c in (free, dear)]
    assert changes[1] < changes[0] / 2
    times = [je.scan.scan_time(je.scan.shortened(protocol, c.rows), 50.0) for c in (free, dear)]
    assert times == pytest.approx([(60 + 50 * n) * 1e-5 for n in changes])
    assert je.scan.scan_time(protocol) == pytest.approx(protocol.frame_time)


def test_a_short_scan_is_the_whole_one_without_the_rest(model, pixels, skin, expected):
    chosen = np.asarray(je.scan.choose_readings(expected, 80).rows)
    flags = np.isin(np.arange(550), chosen)
    short = je.scan.shortened(skin.protocol, chosen)
    np.testing.assert_array_equal(short.pattern, skin.protocol.pattern[np.sort(chosen)])
    np.testing.assert_array_equal(short.pattern, je.scan.shortened(skin.protocol, flags).pattern)
    dv = np.random.default_rng(1).normal(size=(2, 550))
    frame = je.scan.in_frame(dv[:, flags], np.flatnonzero(flags), 550)
    np.testing.assert_array_equal(frame, np.where(flags, dv, np.nan))


@pytest.mark.parametrize("selection", SELECTIONS, ids=lambda s: type(s).__name__)
def test_single_precision_and_jit(rows, selection):
    signal = jnp.asarray(rows @ rows.T, jnp.float32)
    wanted = je.scan.choose_readings(jnp.asarray(rows @ rows.T), 5, selection)
    found = je.scan.choose_readings(signal, 5, selection)
    assert found.gain.dtype == np.float32
    np.testing.assert_array_equal(found.rows, wanted.rows)


def test_what_cannot_be_chosen(model, pixels, expected):
    for count in (0, 551):
        with pytest.raises(je.skin.ProtocolError, match="give 1 to 550"):
            je.scan.choose_readings(expected, count)
    with pytest.raises(je.skin.ProtocolError, match="give pattern="):
        je.scan.choose_readings(expected, 3, switch=1.0)
    with pytest.raises(je.imaging.InverseError, match="one standard deviation per reading"):
        je.scan.signal_covariance(model, basis=pixels, noise=np.eye(550))
    with pytest.raises(je.imaging.InverseError, match="noise of reading 2 is"):
        je.scan.signal_covariance(model, basis=pixels, noise=np.where(np.arange(550) == 2, 0.0, 1.0))


# --- the event-driven scan


def steps(scan, pressures, places=None):
    state, masks = scan.start(), []
    step = eqx.filter_jit(lambda *a: scan.step(*a))
    for pressure in pressures:
        state, mask = step(state, jnp.asarray(pressure, float), places)
        masks.append(np.asarray(mask))
    return masks


def test_pressure_says_what_is_read(scan):
    rest, touch, less = [0, 0, 0, 0], [0, 250, 0, 0], [0, 150, 0, 0]
    masks = steps(scan, [rest, rest, less, touch, less, rest, touch])
    assert masks[0].all()  # first a whole scan
    np.testing.assert_array_equal(masks[1], scan.idle)
    np.testing.assert_array_equal(masks[2], scan.idle)  # below onset
    np.testing.assert_array_equal(masks[3], scan.idle | scan.by_pad[1])
    np.testing.assert_array_equal(masks[4], masks[3])  # above release
    assert masks[5].all()  # the fifth since
    np.testing.assert_array_equal(masks[6], masks[3])
    assert int(scan.idle.sum()) == 12
    assert (np.asarray(scan.by_pad.sum(1)) == 30).all()


def test_a_place_takes_the_place_of_its_pad(scan):
    nowhere = np.full(2, np.nan)
    both = [150, 0, 0, 0], [300, 0, 0, 300]
    place = np.array([[0.03, 0.04], nowhere])
    nearest = int(np.argmin(np.linalg.norm(np.asarray(scan.centres) - place[0], axis=1)))
    assert np.asarray(scan.pad_of)[nearest].tolist() == [True, False, False, False]
    _, rest, touched = steps(scan, [both[0], *both], place)
    np.testing.assert_array_equal(rest, scan.idle)  # a contact that no pad feels is none
    np.testing.assert_array_equal(touched, scan.idle | scan.by_place[nearest] | scan.by_pad[3])
    _, unknown = steps(scan, [both[1], both[1]], np.stack([nowhere, nowhere]))
    np.testing.assert_array_equal(unknown, scan.idle | scan.by_pad[0] | scan.by_pad[3])


def test_a_pad_that_is_not_heard_counts_as_pressed(scan):
    _, mask = steps(scan, [[0, 0, 0, 0], [0, 0, np.nan, 0]])
    np.testing.assert_array_equal(mask, scan.idle | scan.by_pad[2])


def test_steps_run_in_a_compiled_loop(scan):
    pressures = jnp.asarray(np.random.default_rng(0).uniform(0, 300, (20, 4)))
    _, masks = jax.lax.scan(lambda state, p: scan.step(state, p), scan.start(), pressures)
    np.testing.assert_array_equal(masks, steps(scan, pressures))


def test_readings_around_a_contact_are_the_ones_it_changes_most(model, pixels, scan):
    """The local scan sees a touch there with more signal than the same number of readings on average."""
    j = np.asarray(je.jacobian(model, None, pixels))
    for mask, centre in zip(np.asarray(scan.by_place), scan.centres, strict=True):
        power = (j @ np.asarray(je.scan.around(pixels, centre, 0.02))) ** 2
        assert power[mask].mean() > 2 * power.mean()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"onset": 1.0, "release": 2.0}, "no less than release"),
        ({"onset": np.nan}, "give finite ones"),
        ({"onset": 1.0, "every": 0}, "one frame or more"),
        ({"onset": 1.0, "radius": 0.0}, "metres above 0"),
    ],
)
def test_an_event_scan_that_makes_no_sense(model, skin, settings, said):
    with pytest.raises(je.skin.ProtocolError, match=said):
        je.scan.prepare_event_scan(model, skin, je.scan.EventScanSettings(**settings))


def test_a_short_scan_has_no_more_readings_than_it_has(model, skin, pixels):
    few = skin.protocol.pattern[::25]
    short = je.Skin("short", skin.domain, 150.0, skin.electrodes, je.Protocol(few), skin.pads)
    settings = je.scan.EventScanSettings(onset=200.0, radius=0.1)
    scan = je.scan.prepare_event_scan(eqx.tree_at(lambda m: m.pattern, model, few), short, settings, basis=pixels)
    assert scan.by_pad.shape == (4, 22)
    assert scan.by_pad.all()


def test_dead_channels_are_in_no_choice_of_readings(model, skin, pixels, scan):
    settings = je.scan.EventScanSettings(onset=200.0, idle=12, local=30, every=5, radius=0.1)
    dead = np.asarray(scan.idle)  # those that a scan at rest would take
    noise = np.where(dead, np.nan, 1e-5)  # V; of a dead channel nothing is known
    other = je.scan.prepare_event_scan(model, skin, settings, basis=pixels, noise=noise, channels=~dead)
    for chosen, count in ((other.idle[None], 12), (other.by_pad, 30), (other.by_place, 30)):
        assert not (np.asarray(chosen) & dead).any()
        assert (np.asarray(chosen).sum(1) == count).all()


def test_a_scan_of_few_channels_takes_no_dead_ones(model, skin, pixels):
    few = np.arange(550) < 20
    settings = je.scan.EventScanSettings(onset=200.0, radius=0.1)
    scan = je.scan.prepare_event_scan(model, skin, settings, basis=pixels, channels=few)
    np.testing.assert_array_equal(scan.by_pad, np.tile(few, (4, 1)))


def test_unused_readings_have_no_covariance(model, pixels):
    used, noise = np.arange(550) % 7 > 0, np.linspace(1, 2, 550)
    part = je.scan.signal_covariance(model, basis=pixels, noise=noise, channels=used)
    whole = np.asarray(je.scan.signal_covariance(model, basis=pixels, noise=np.where(used, noise, 1e6)))
    assert not np.asarray(part)[~used].any()
    shape = np.asarray(part)[used][:, used] / whole[used][:, used]  # the strength of the prior counts used readings
    np.testing.assert_allclose(shape, shape[0, 0], rtol=1e-4)
    with pytest.raises(je.imaging.InverseError, match="every channel is left out"):
        je.scan.signal_covariance(model, basis=pixels, channels=np.zeros(550, bool))


def test_an_event_scan_needs_pads(model, skin):
    bare = je.Skin("bare", skin.domain, skin.sheet_resistance, skin.electrodes, skin.protocol)
    with pytest.raises(je.skin.ProtocolError, match="has no pads"):
        je.scan.prepare_event_scan(model, bare, je.scan.EventScanSettings(onset=1.0))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("x", 2), "signal is 'x'; give an array of real numbers"),
        ((np.eye(6) * 1j, 2), "signal is complex"),
        ((np.ones((6, 5)), 2), r"signal has shape \(6, 5\); give \(readings, readings\), from signal_covariance"),
        ((np.full((6, 6), np.nan), 2), "signal has entries that are not finite"),
        ((np.eye(6), "2"), "count is '2', and this scan has 6 readings"),
        ((np.eye(6), 2, "x"), "choose_readings: 'x' is not a selection; give an object, such as"),
    ],
)
def test_what_is_no_signal_is_refused(given, said):
    with pytest.raises(je.skin.ProtocolError, match=said):
        je.scan.choose_readings(*given)
