"""Misplaced electrodes, found from what the skin reads."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging import InverseError, KnownPresses, fit_electrodes
from jaxeit.model import MotionError
from jaxeit.toml import TomlError

from ..helpers import square_model

MISPLACED = 1.1e-3  # m, in each direction
POINTS = [(0.05, 0.05), (0.15, 0.05), (0.125, 0.15), (0.05, 0.125)]


def _field(rng, places, std, length):
    """A smooth random field at places (n, 2), by random waves: another method than the prior of the fit."""
    waves = rng.normal(size=(400, 2)) / length
    phase = rng.uniform(0, 2 * np.pi, 400)
    return std * np.sqrt(2 / 400) * np.cos(places @ waves.T + phase).sum(1)


def _recorded(skin, seed, side):
    """Shifts, an untouched frame, and presses of a flat tip on a grid, on a mesh of their own."""
    rng = np.random.default_rng(seed)
    shift = rng.normal(scale=MISPLACED, size=(25, 2))
    bolts = [
        replace(bolt, position=tuple(np.array(bolt.position) + by))
        for bolt, by in zip(skin.electrodes, shift, strict=True)
    ]
    model = je.discretise(je.Scene(replace(skin, electrodes=tuple(bolts))), je.Fidelity.standard())
    at = np.asarray(model.centroids)
    sigma = model.background * np.exp(_field(rng, at, 0.15, 0.03))
    gain = np.exp(_field(rng, at, 0.12, 0.015))
    v0 = np.asarray(je.forward(model, sigma))
    noise = 1e-4 * np.sqrt(np.mean(v0**2))  # of the mean of a hundred frames, 60 dB each
    row = np.linspace(0.03, 0.17, side)
    places = np.stack(np.meshgrid(row, row), -1).reshape(-1, 2)
    flat = [0.5 * gain / (1 + np.exp((np.linalg.norm(at - place, axis=1) - 0.014) / 0.003)) for place in places]
    pressed = np.stack([np.asarray(je.forward(model, sigma * (1 + touch))) for touch in flat])
    change = pressed - v0 + rng.normal(scale=np.sqrt(2) * noise, size=pressed.shape)
    presses = KnownPresses(change, places, np.full(len(v0), np.sqrt(2) * noise))
    return shift, v0 + rng.normal(scale=noise, size=v0.shape), presses


@pytest.fixture(scope="module")
def nominal(skin):
    return je.discretise(je.Scene(skin), je.Fidelity(order=2, edge_length=je.Fidelity.draft().edge_length))


@pytest.mark.slow
@pytest.mark.parametrize(("pressed", "largest"), [(False, (0.7e-3, 0.4e-3)), (True, (0.6e-3, 0.2e-3))])
def test_electrodes_are_found(skin, nominal, pressed, largest):
    """Seeds that nothing was chosen by; errors agree with their standard errors."""
    errors, pulls = [], []
    for seed in (11, 12):
        shift, v0, presses = _recorded(skin, seed, 3)
        v0[[3, 77]] = np.nan
        fit = fit_electrodes(nominal, v0, presses if pressed else None)
        error = np.asarray(fit.shift) - shift
        errors.append(error)
        pulls.append(error / np.asarray(fit.standard_error))
        assert 0 < float(fit.misfit) < 1
        assert fit.converged
    inner = np.abs(skin.electrode_positions - 0.1).max(1) < 0.05
    for found, limit in zip((np.array(errors), np.array(errors)[:, inner]), largest, strict=True):
        assert np.sqrt(np.mean(np.square(found))) < limit
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.3
    assert 0.8 < np.mean(np.abs(pulls) < 1.645) <= 1


def test_what_cannot_be_fitted_is_refused(skin):
    model = square_model(POINTS, [[0, 1, 2, 3], [1, 2, 3, 0]], 8)
    frame, one = je.forward(model), jnp.ones((1, 2))
    with pytest.raises(InverseError, match=r"give the 2 readings"):
        fit_electrodes(model, jnp.ones(3))
    with pytest.raises(InverseError, match="opposite sign"):
        fit_electrodes(model, -frame)
    with pytest.raises(InverseError, match=r"change has shape \(1, 3\); give \(1, 2\)"):
        fit_electrodes(model, frame, KnownPresses(jnp.ones((1, 3)), one, jnp.ones(2)))
    with pytest.raises(InverseError, match="place has a value that is not finite"):
        fit_electrodes(model, frame, KnownPresses(one, one * jnp.nan, jnp.ones(2)))
    with pytest.raises(InverseError, match="noise has a value that is not above zero"):
        fit_electrodes(model, frame, KnownPresses(one, one, jnp.zeros(2)))
    with pytest.raises(InverseError, match="decides by looking at values"):
        jax.jit(lambda v0: fit_electrodes(model, v0).shift)(frame)
    coated = je.discretise(je.Scene(skin, (je.effects.ContinuousCoating(),)), je.Fidelity.draft())
    with pytest.raises(MotionError, match="metal coat"):
        fit_electrodes(coated, jnp.ones(550))


def test_a_skin_with_its_electrodes_elsewhere(skin):
    places = skin.electrode_positions + np.random.default_rng(0).normal(scale=1e-3, size=(25, 2))
    there = je.skin.with_positions(skin, places)
    np.testing.assert_allclose(there.electrode_positions, places, atol=1e-9)
    assert "[electrodes.grid]" not in there.toml
    assert "sheet_resistance = 150.0" in there.toml
    again = je.skin.with_positions(je.skin.parse_skin(there.toml), skin.electrode_positions)
    np.testing.assert_allclose(again.electrode_positions, skin.electrode_positions, atol=1e-9)
    assert again.toml.count("positions") == 1
    for name in je.skin.shipped_skins():
        shipped = je.load_skin(name)
        np.testing.assert_allclose(
            je.skin.with_positions(shipped, shipped.electrode_positions).electrode_positions,
            shipped.electrode_positions,
            atol=1e-9,
        )
    with pytest.raises(TomlError, match=r"shape \(2,\); give two coordinates to each of 25"):
        je.skin.with_positions(skin, np.zeros(2))
    with pytest.raises(TomlError, match="outside the sheet"):
        je.skin.with_positions(skin, places + 1)
    with pytest.raises(TomlError, match=r"no text with a table \[electrodes\]"):
        je.skin.with_positions(replace(skin, toml=""), places)
    rim = skin.toml.replace('kind = "bolt" ', 'kind = "edge" ')
    with pytest.raises(TomlError):
        je.skin.with_positions(replace(skin, toml=rim.replace("[electrodes.grid]", "[electrodes.other]")), places)
