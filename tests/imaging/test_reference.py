"""Conductivity, contacts, channels and places of electrodes from one frame, against the disc's exact solution."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging import InverseError, ReferenceSettings, fit_reference
from jaxeit.imaging.absolute.frames import frame_error

from ..helpers import skin_of
from ..oracles.disc import even_disc

COUNT, RADIUS, SIGMA, CURRENT = 16, 0.1, 0.137, 1e-3
RING = np.eye(COUNT) - np.roll(np.eye(COUNT), 1, 0)
ROWS = je.skin.adjacent(COUNT)


def _tank(protocol, effects=(), **changes):
    disc = je.Disc(RADIUS)
    rim = je.skin.rim_electrodes(disc, COUNT, contact=2e-2)
    scene = je.Scene(replace(skin_of(disc, rim, ROWS), protocol=protocol), effects)
    return je.discretise(scene, je.Fidelity(order=2, **changes))


@pytest.fixture(scope="module")
def saline():
    """Contact impedances of a tank of saline, ohm m, and its potentials, by the seed."""
    potentials = even_disc(COUNT)

    def simulated(seed, currents, typical=6e-2):
        z = typical * np.exp(0.7 * np.random.default_rng([5, seed]).normal(size=COUNT))
        return z, potentials(z * SIGMA / RADIUS, currents) / SIGMA

    return simulated


@pytest.fixture(scope="module")
def adjacent():
    return _tank(je.Protocol(ROWS, CURRENT), edge_length=0.06)


def _rows(potential):
    """Readings of `ROWS` from the potentials by a unit current into each electrode."""
    source, sink, plus, minus = ROWS.T
    felt = potential[:, source] - potential[:, sink]
    reading = np.arange(len(ROWS))
    return CURRENT * (felt[plus, reading] - felt[minus, reading])


def _recorded(frame, seed, error=3e-3):
    noise = np.random.default_rng([6, seed]).normal(size=frame.shape)
    return frame + np.asarray(frame_error(jnp.asarray(frame), error)) * noise


@pytest.mark.slow
def test_level_and_contacts_within_their_errors(saline):
    """Twenty fresh tanks whose driven electrodes sense too, contacts uneven by a factor of two and thrice the model's:
    the level is right within 2 %, every contact within its error. With the model's own contacts,
    even saline looks uneven."""
    model = _tank(je.Protocol.from_matrices(CURRENT * RING, RING), edge_length=0.025)
    coarse = _tank(je.Protocol.from_matrices(CURRENT * RING, RING), edge_length=0.06)
    levels, pulls = [], []
    for seed in range(20):
        z, potential = saline(seed, CURRENT * RING)
        frame = _recorded((RING.T @ potential).T.ravel(), seed)
        frame[[3, 77]] = np.nan
        fit = fit_reference(model, frame, ReferenceSettings(scale=0))  # the mesh is finer than the noise
        assert abs(fit.value.level / SIGMA - 1) < 0.02
        assert not fit.untold
        assert 0.7 < fit.misfit < 1.3
        levels.append(np.log(fit.value.level / SIGMA) / fit.standard_error.level)
        pulls.append(np.log(fit.value.contact / z) / np.asarray(fit.standard_error.contact))
        assert np.mean(fit.standard_error.contact) < 0.01
    uneven = np.asarray(je.fit_background(coarse, frame))
    assert np.sqrt(np.average((uneven / SIGMA - 1) ** 2, weights=coarse.areas)) > 0.1
    assert abs(np.mean(pulls)) < 0.25
    assert 0.9 < np.std(pulls) < 1.1
    assert abs(np.mean(levels)) < 0.7
    assert 0.6 < np.std(levels) < 1.4


@pytest.mark.slow
def test_what_a_draft_mesh_leaves_is_in_the_errors(saline):
    """Contacts of the driven electrodes, readings all but free of noise: the error is that of the mesh."""
    model = _tank(je.Protocol.from_matrices(CURRENT * RING, RING), edge_length=0.06)
    levels, contacts = [], []
    for seed in range(3):
        z, potential = saline(seed, CURRENT * RING)
        fit = fit_reference(model, _recorded((RING.T @ potential).T.ravel(), seed, 1e-4))
        levels.append(np.log(fit.value.level / SIGMA) / fit.standard_error.level)
        contacts.append(np.log(fit.value.contact / z) / np.asarray(fit.standard_error.contact))
    assert np.max(np.abs(levels)) < 1.645
    assert np.sqrt(np.mean(np.square(contacts))) < 1.3


@pytest.mark.slow
def test_what_a_mesh_misses_near_electrodes_is_in_the_errors(saline):
    """Good contacts, of which the mesh misses more than readings all but free of noise do."""
    model = _tank(je.Protocol.from_matrices(CURRENT * RING, RING), edge_length=0.06)
    z, potential = saline(11, CURRENT * RING, 4e-3)
    frame = _recorded((RING.T @ potential).T.ravel(), 11, 1e-3)
    fit = fit_reference(model, frame)
    error = np.log(np.asarray(fit.value.contact) / z)
    assert np.sqrt(np.mean(np.square(error / np.asarray(fit.standard_error.contact)))) < 1.3
    exact = fit_reference(model, frame, ReferenceSettings(scale=0))
    assert np.sqrt(np.mean(np.square(error / np.asarray(exact.standard_error.contact)))) > 3
    np.testing.assert_allclose(jnp.sqrt(jnp.diag(fit.covariance))[1:17], fit.standard_error.contact)


@pytest.mark.slow
def test_an_offset_of_the_readings_is_named_and_fitted(saline, adjacent):
    """As in the tank of PyEIDORS: damped steps did not end, and the refusal did not say why."""
    _, potential = saline(12, np.eye(COUNT) - 1 / COUNT)
    frame = _rows(potential)
    offset = 0.35 * np.sqrt(np.mean(frame**2))
    with pytest.raises(
        InverseError, match=r"[2-9]\d% of it is left.*an offset of -.* leaves \d%: fit it by ReferenceSettings\(offset="
    ):
        fit_reference(adjacent, frame - offset)
    fit = fit_reference(adjacent, frame - offset, ReferenceSettings(offset=2 * offset))
    assert abs(fit.value.level / SIGMA - 1) < 0.02
    np.testing.assert_allclose(fit.value.offset, -offset, rtol=0.02)


@pytest.mark.slow
def test_contacts_that_no_driven_electrode_tells(saline, adjacent):
    """Readings of electrodes that carry no current feel contacts little; the level is right all the same."""
    pulls = []
    for seed in range(4):
        z, potential = saline(seed, np.eye(COUNT) - 1 / COUNT)
        fit = fit_reference(adjacent, _recorded(_rows(potential), seed))
        assert abs(fit.value.level / SIGMA - 1) < 0.005
        pulls.append(np.log(fit.value.contact / z) / np.asarray(fit.standard_error.contact))
    assert np.sqrt(np.mean(np.square(pulls))) < 1.3
    alike = fit_reference(adjacent, _recorded(_rows(potential), 0), ReferenceSettings(contact_each=0))
    assert np.ptp(alike.value.contact) == 0
    np.testing.assert_allclose(je.forward(alike.model) / _rows(potential), 1, atol=0.1)


@pytest.mark.slow
def test_gains_and_offsets_of_channels(saline, adjacent):
    """One gain in common is told by nothing; what each channel has of its own is found within its error."""
    _, potential = saline(7, np.eye(COUNT) - 1 / COUNT)
    frame = _rows(potential)
    channel = np.unique(ROWS[:, 2:], axis=0, return_inverse=True)[1].ravel()
    rng = np.random.default_rng(7)
    typical = np.sqrt(np.mean(frame**2))
    gain, offset = 0.02 * rng.normal(size=COUNT), 0.01 * typical * rng.normal(size=COUNT)
    seen = _recorded((1 + gain[channel]) * frame + offset[channel], 7)
    fit = fit_reference(adjacent, seen, ReferenceSettings(gain=0.02, offset=0.01 * typical))
    together = [np.mean(direction.gain) / np.std(direction.gain) for direction in fit.untold]
    assert np.max(np.abs(together)) > 5
    own = np.asarray(fit.value.gain) - gain
    for error, stated in ((own, fit.standard_error.gain), (fit.value.offset - offset, fit.standard_error.offset)):
        assert np.sqrt(np.mean(np.square(error / np.asarray(stated)))) < 1.6
    assert np.std(own) < 0.5 * np.std(gain)
    known = fit_reference(
        replace_background(adjacent), seen, ReferenceSettings(level=0, gain=0.02, offset=0.01 * typical)
    )
    assert known.value.level == pytest.approx(SIGMA)
    assert known.standard_error.level == 0
    np.testing.assert_array_less(known.standard_error.gain, np.asarray(fit.standard_error.gain))


def replace_background(model):
    """The model with the conductivity of the saline."""
    return replace(model, background=jnp.full_like(model.background, SIGMA))


@pytest.mark.slow
def test_electrodes_that_sit_elsewhere(adjacent):
    """Shifts along the rim, on a mesh of their own."""
    turns = np.random.default_rng(1).normal(scale=0.01, size=COUNT)
    disc = je.Disc(RADIUS)
    rim = je.skin.rim_electrodes(disc, 2 * np.pi * np.arange(COUNT) / COUNT + turns, width=0.5 * disc.perimeter / COUNT)
    there = je.discretise(je.Scene(skin_of(disc, rim, ROWS, current=CURRENT)), je.Fidelity(edge_length=0.05, order=2))
    fit = fit_reference(adjacent, je.forward(there), ReferenceSettings(shift=1e-3))
    angle = 2 * np.pi * np.arange(COUNT) / COUNT
    along = np.stack([-np.sin(angle), np.cos(angle)], 1)
    error = np.sum(np.asarray(fit.value.shift) * along, 1) - RADIUS * turns
    # All electrodes turned by one angle read the same.
    assert np.std(error) < 0.2 * np.std(RADIUS * turns)
    assert len(fit.untold) > COUNT // 2  # shifts across the rim do nothing


@pytest.mark.slow
def test_what_cannot_be_fitted_is_refused(adjacent):
    frame = je.forward(adjacent)
    with pytest.raises(InverseError, match="give the 208 readings"):
        fit_reference(adjacent, jnp.ones(3))
    with pytest.raises(InverseError, match="opposite sign"):
        fit_reference(adjacent, -frame)
    with pytest.raises(InverseError, match="no even content explains"):
        fit_reference(adjacent, frame[::-1] * np.where(np.arange(208) % 2, 3.0, 1.0))
    with pytest.raises(InverseError, match="gain is -1"):
        ReferenceSettings(gain=-1.0)
    with pytest.raises(InverseError, match="all standard deviations are zero"):
        ReferenceSettings(0, 0, 0)
    with pytest.raises(InverseError, match=r"channel has shape \(3,\)"):
        fit_reference(adjacent, frame, ReferenceSettings(gain=0.01), channel=np.arange(3))
    matrices = _tank(je.Protocol.from_matrices(CURRENT * (RING + np.roll(RING, 3, 0)), RING), edge_length=0.1)
    with pytest.raises(InverseError, match="no CommonMode"):
        fit_reference(adjacent, frame, ReferenceSettings(common_mode=0.01))
    with pytest.raises(InverseError, match="give channel="):
        fit_reference(matrices, je.forward(matrices), ReferenceSettings(gain=0.01))
    points = [je.PointElectrode((x, y)) for x, y in ((0.05, 0.05), (0.15, 0.05), (0.1, 0.15), (0.05, 0.12))]
    perfect = je.discretise(je.Scene(skin_of(je.Rectangle(0.2, 0.2), points, je.skin.adjacent(4))), je.Fidelity.draft())
    with pytest.raises(InverseError, match="no electrode of the model has a contact resistance"):
        fit_reference(perfect, je.forward(perfect))
    jax.jit(lambda frame: fit_reference(adjacent, frame).value.level)(frame)


@pytest.mark.slow
def test_the_gain_for_the_common_mode(saline):
    """Readings with it, made here from the potentials of the exact solution."""
    gain, (_, potential) = 8e-3, saline(9, np.eye(COUNT) - 1 / COUNT)
    source, sink, plus, minus = ROWS.T
    felt, reading = potential[:, source] - potential[:, sink], np.arange(len(ROWS))
    above = felt - felt[sink, reading]
    shared = CURRENT * 0.5 * (above[plus, reading] + above[minus, reading])
    amplifier = (je.effects.CommonMode(gain=0.0),)
    model = _tank(je.Protocol(ROWS, CURRENT), amplifier, edge_length=0.06)
    fit = fit_reference(model, _recorded(_rows(potential) + gain * shared, 9), ReferenceSettings(common_mode=1e-2))
    assert abs(fit.value.common_mode - gain) < 3 * fit.standard_error.common_mode
    assert fit.standard_error.common_mode < 0.2 * gain
