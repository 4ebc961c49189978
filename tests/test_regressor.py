"""The regressor of the benchmarks: what it says, how its last layer is adapted, and what is read from maps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import bench_regressor
from benchmarks.force_ways import peaks
from benchmarks.regressor import Adapted, Belief, Errors, Regressor, inputs
from benchmarks.second_simulator import Press, true_map
from calib.learning.inputs import Compression

PIXELS, READINGS, MODES = 20, 6, 3
CENTRES = (0.2 / PIXELS) * (np.stack(np.meshgrid(np.arange(PIXELS), np.arange(PIXELS)), -1).reshape(-1, 2) + 0.5)
LEFT = CENTRES[:, 0] < 0.1
MASKS = np.stack([LEFT, ~LEFT]).astype(float)


@pytest.fixture(scope="module")
def adapted():
    """A network with random weights for two pads."""
    keys, outputs = jax.random.split(jax.random.key(0), 3), 1 + len(CENTRES)
    network = Regressor(
        eqx.nn.MLP(READINGS + 1 + 2 * len(MASKS) + 2, 8, 16, 1, dtype=jnp.float32, key=keys[0]),
        jax.random.normal(keys[1], (outputs, 9), jnp.float32),
        0.3 * jax.random.normal(keys[2], (MODES, outputs, 9), jnp.float32),
    )
    unit = Compression(
        np.array(1.0), np.eye(READINGS), np.ones(READINGS), np.zeros(READINGS + 1), np.ones(READINGS + 1)
    )
    prior = Belief(np.zeros(MODES), *2 * [np.diag([1.0, 0.5, 0.25])])
    return Adapted(network, unit, prior, MASKS, CENTRES, Errors(0.05, 0.01, 0.002))


def test_inputs_are_the_same_in_numpy_and_jax():
    rng = np.random.default_rng(0)
    seen, pads, known = rng.normal(size=(5, 7)).astype(np.float32), rng.uniform(0, 9, (5, 2)), rng.random((5, 2)) < 0.5
    pads = pads.astype(np.float32)
    found = inputs(seen, pads, known)
    np.testing.assert_allclose(found, inputs(*map(jnp.asarray, (seen, pads, known))), rtol=1e-6)
    np.testing.assert_array_equal(found[:, -1], known.all(1))
    np.testing.assert_allclose(np.exp(found[known.all(1), -2]), pads[known.all(1)].sum(1), rtol=1e-6)


def test_maps_sum_to_the_total_force(adapted):
    dv = np.random.default_rng(1).normal(size=(4, READINGS))
    maps = adapted.maps(adapted.prior, dv, np.full((4, 2), 3.0))
    force, _ = adapted.network(adapted.inputs(dv, np.full((4, 2), 3.0)), np.zeros(MODES, np.float32))
    assert (maps > 0).all()
    np.testing.assert_allclose(maps.sum(1), np.exp(np.asarray(force)), rtol=1e-5)


def test_a_press_updates_the_belief_as_the_information_form_says(adapted):
    """The covariance is the inverse of the prior's inverse and the information of the press."""
    dv, forces = np.random.default_rng(2).normal(size=READINGS), np.array([2.0, 5.0])
    for place in (None, np.array([0.07, 0.12])):
        after = adapted.told(adapted.prior, dv, forces, place)
        assert np.linalg.eigvalsh(adapted.prior.covariance - after.covariance).min() > -1e-9
        # A belief that is narrow about a code is linear there, whatever the forces are.
        narrow = after._replace(covariance=1e-8 * adapted.prior.covariance)
        count = 2 if place is None else 4
        slope = np.asarray(adapted._said(adapted.inputs(dv[None]), after.mean.astype(np.float32))[1], float)[:count]
        noise = adapted.errors.of(forces)[:count]
        expected = np.linalg.inv(np.linalg.inv(narrow.covariance) + slope.T @ np.diag(noise**-2) @ slope)
        np.testing.assert_allclose(adapted.told(narrow, dv, forces, place).covariance, expected, rtol=1e-3)


def test_presses_of_a_skin_teach_its_code(adapted):
    """A skin whose layer is the network's with another code: what pads tell, brings what the network says to it."""
    rng, code = np.random.default_rng(3), np.array([0.8, -0.6, 0.3])
    dv = rng.normal(size=(60, READINGS))
    true = adapted.maps(adapted.prior._replace(mean=code), dv)
    now = adapted.prior
    for frame, forces in zip(dv[:40], (true @ MASKS.T)[:40], strict=True):
        now = adapted.told(now, frame, forces * np.exp(0.03 * rng.normal(size=2)))
    errors = [np.abs(np.log(adapted.maps(b, dv[40:]).sum(1) / true[40:].sum(1))).mean() for b in (adapted.prior, now)]
    assert errors[1] < 0.2 * errors[0]
    np.testing.assert_allclose(now.mean, code, atol=4 * np.sqrt(np.diag(now.covariance)).max())


def test_places_of_maps():
    for places in (np.array([[0.083, 0.121]]), np.array([[0.083, 0.121], [0.122, 0.121]])):
        image = np.exp(-0.5 * ((CENTRES[:, None] - places) ** 2).sum(2) / 0.009**2).sum(1)
        found = peaks(image, CENTRES)
        assert len(found) == len(places)
        away = np.linalg.norm(found[:, None] - places, axis=2)
        assert away.min(0).max() < (1e-6 if len(places) == 1 else 2e-3)


def test_the_true_map_has_all_of_the_force():
    press = Press(np.array([[0.09, 0.11]]), np.array([12.0]), 0.02)
    shown = true_map(press, CENTRES)
    assert shown.sum() == pytest.approx(12)
    np.testing.assert_allclose(peaks(shown, CENTRES)[0], press.places[0], atol=2e-4)


@pytest.mark.slow
def test_smoke_regressor():
    data = bench_regressor.main(["--smoke"])
    for part in ("one", "two"):
        assert {row["way"].split(":")[0] for row in data[part]} == {"physics", "learned", "both"}
        fused = [row for row in data[part] if "pads" in row["way"] or row["way"].startswith("physics")]
        assert all(row["force"] < 0.2 and 0 <= row["wrong"] <= 1 for row in fused)
    assert {row["skin"] for row in data["unlike"]} == set(bench_regressor.UNLIKE)
    assert len({row["minutes"] for row in data["drift"]}) == bench_regressor.WINDOWS
