"""Protocols of current and voltage matrices against sums of four-electrode readings; electrodes around a rim."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging.storage import StorageError, to_numbers
from jaxeit.linalg import Dense
from jaxeit.skin import ElectrodeError, ProtocolError

from ..helpers import skin_of
from ..oracles.disc import even_disc

COUNT = 6
DISC = je.Disc(0.1)
RNG = np.random.default_rng(5)
CURRENT = RNG.normal(size=(COUNT, 4))
CURRENT -= CURRENT.mean(0)


@pytest.fixture(scope="module")
def model_of():
    """The model of a tank with a protocol; all share one mesh."""
    rim = je.skin.rim_electrodes(DISC, COUNT, contact=0.02)
    fidelity = je.Fidelity(edge_length=0.12, solver=Dense())
    scene = je.Scene(skin_of(DISC, rim, je.skin.adjacent(COUNT)))
    mesh = je.model.make_mesh(scene, fidelity)

    def of(protocol, effects=()):
        skin = dataclasses.replace(scene.skin, protocol=protocol)
        return je.discretise(je.Scene(skin, effects), fidelity, mesh=mesh)

    return of


@pytest.fixture(scope="module")
def potentials(model_of):
    """Potentials of each electrode above the last, per ampere in at each and out at the last, from plain rows."""
    last = COUNT - 1
    rows = [[a, last, b, last] for a in range(last) for b in range(last)]
    z = np.zeros((COUNT, COUNT))
    z[:last, :last] = np.asarray(je.forward(model_of(je.Protocol(np.array(rows), 1.0)))).reshape(last, last).T
    return z


MEASURED = {
    "above the mean": np.eye(COUNT) - 1 / COUNT,
    "adjacent": (np.eye(COUNT) - np.roll(np.eye(COUNT), 1, 0))[:, :4],
    "another for each drive": [RNG.normal(size=(COUNT, 2 + d)) for d in range(4)],
}


@pytest.mark.parametrize("name", MEASURED)
def test_readings_are_sums_of_those_of_pairs(model_of, potentials, name):
    measured = MEASURED[name]
    reference = 2 if isinstance(measured, list) else None
    protocol = je.Protocol.from_matrices(1e-3 * CURRENT, measured, reference=reference)
    expected = []
    for drive in range(4):
        u = 1e-3 * potentials @ CURRENT[:, drive]
        columns = measured[drive] if reference else measured
        expected.append(columns.T @ (u if reference is None else u - u[reference]))
    found = je.forward(model_of(protocol))
    assert protocol.readings == len(found)
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-11, atol=1e-14)


def test_matrices_of_pairs_are_plain_rows():
    """Also in their order and sign; one larger current is a share of its own."""
    rows, pairs = je.skin.adjacent(COUNT), np.eye(COUNT) - np.roll(np.eye(COUNT), 1, 0)
    senses = [pairs[:, [(d + k) % COUNT for k in range(2, COUNT - 1)]] for d in range(COUNT)]
    plain = je.Protocol.from_matrices(2e-3 * pairs, senses)
    assert plain.mixing is None
    np.testing.assert_array_equal(plain.pattern, rows)
    assert plain.current == pytest.approx(2e-3)
    own = je.Protocol.from_matrices(2e-3 * pairs * np.linspace(1, 0.5, COUNT), senses)
    assert own.mixing.nnz == own.readings == len(rows)
    few = own.only(np.array([4, 7]))
    assert (few.readings, len(few.pattern)) == (2, 2)


@pytest.fixture(scope="module")
def trigonometric(model_of):
    """Cosine and sine currents, voltages above the mean."""
    angle = 2 * np.pi * np.outer(np.arange(COUNT), [1, 2])
    current = np.concatenate([np.cos(angle / COUNT), np.sin(angle / COUNT)], 1)
    return model_of(je.Protocol.from_matrices(current, MEASURED["above the mean"]))


def test_jacobian_and_image_are_those_of_the_dense_formula(trigonometric):
    """NaN are left out as if never taken, in JAX and in NumPy; noise differs from reading to reading."""
    model = trigonometric
    image = je.Pixels(6).on(model)
    jacobian = np.asarray(je.jacobian(model, basis=image))
    slope = jax.jvp(lambda s: je.forward(model, s), (model.background,), (model.background,))[1]
    whole = np.asarray(je.jacobian(model)) @ np.asarray(model.background)
    np.testing.assert_allclose(whole, slope, rtol=1e-9, atol=1e-12)

    noise = np.linspace(1, 2, model.readings)
    recon = je.prepare(model, je.Tikhonov(), basis=image, noise=noise, hyperparameter=0.3)
    dv = jacobian @ np.linspace(-1, 1, image.size)
    for missing in ([], [3], range(2, 19)):
        kept = np.isin(np.arange(len(dv)), list(missing), invert=True)
        frame = np.where(kept, dv, np.nan)
        weighted = jacobian[kept] / noise[kept, None]
        areas = np.asarray(image.areas)
        all_of = jacobian / noise[:, None]
        inside = areas > 0
        precision = np.diag(areas[inside] / areas[inside].mean())
        scale = np.trace(all_of[:, inside] @ np.linalg.inv(precision) @ all_of[:, inside].T) / len(dv)
        gram = weighted[:, inside].T @ weighted[:, inside] + 0.3**2 * scale * precision
        expected = np.linalg.solve(gram, weighted[:, inside].T @ (dv[kept] / noise[kept]))
        found = np.asarray(recon(jnp.asarray(frame)))
        np.testing.assert_allclose(found[inside], expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
        np.testing.assert_allclose(recon.on_host()(frame), found, rtol=1e-8, atol=1e-10 * np.abs(found).max())


def test_the_named_scan_against_the_disc_in_closed_form():
    """Against the semi-analytic disc; by symmetry, the potentials of a drive are in proportion to its currents."""
    z, count, current = 0.05, 16, 2e-3
    rim = je.skin.rim_electrodes(je.Disc(1.0), count, contact=z)
    protocol = je.skin.named_protocol("trigonometric", count, current)
    tank = je.Skin("tank", je.Disc(1.0), 1.0, rim, protocol)
    found = je.forward(je.discretise(je.Scene(tank), je.Fidelity(edge_length=0.04, order=2, solver=Dense())))
    angle = 2 * np.pi * np.arange(count) / count
    waves = np.array([np.cos(k * angle) for k in range(1, 9)] + [np.sin(k * angle) for k in range(1, 8)])
    exact = even_disc(count)(np.full(count, z), current * waves.T)
    expected = (exact - np.roll(exact, -1, 0)).T  # electrode n less electrode n + 1
    np.testing.assert_allclose(np.reshape(found, (15, 16)), expected, atol=2e-3 * np.abs(expected).max())
    steps = waves - np.roll(waves, -1, 1)
    resistance = np.sum(np.reshape(found, (15, 16)) * steps, 1) / np.sum(steps**2, 1)
    np.testing.assert_allclose(resistance[:7], resistance[8:], rtol=1e-3)  # a cosine as its sine
    assert (np.diff(resistance[:8]) < 0).all()


@pytest.mark.slow
def test_contacts_are_found(trigonometric):
    model = trigonometric
    inside = jnp.linalg.norm(model.centroids - jnp.array([0.03, -0.02]), axis=1) < 0.02
    dv = je.forward(model, jnp.where(inside, 1.3, 1.0) * model.background) - je.forward(model)
    noise = jnp.full(model.readings, 1e-5)
    finder = je.prepare_contacts(model, je.contacts.ContactSettings(most=1, columns=15), noise=noise)
    found = finder(dv)
    assert bool(found.present[0])
    np.testing.assert_allclose(found.position[0], [0.03, -0.02], atol=0.01)


def test_a_stored_reconstructor_gives_the_same_images(trigonometric, tmp_path):
    recon = je.prepare(trigonometric, basis=je.Pixels(6))
    je.save_reconstructor(recon, tmp_path / "recon.npz")
    again = je.load_reconstructor(tmp_path / "recon.npz")
    dv = np.random.default_rng(0).normal(size=trigonometric.readings).astype(trigonometric.dtype)
    lacking = np.where(np.arange(len(dv)) < 3, np.nan, dv)
    for frame in (dv, lacking):
        np.testing.assert_allclose(again(frame), recon(frame), rtol=1e-6, atol=1e-6 * np.abs(recon(frame)).max())
    numbers = to_numbers(recon)
    del numbers["shares"]
    with pytest.raises(StorageError, match="without shares, give four"):
        je.imaging.from_numbers(numbers, recon.shape, recon.extent)


def test_what_has_no_pairs_is_refused(model_of, trigonometric):
    protocol = je.Protocol.from_matrices(CURRENT, MEASURED["above the mean"])
    with pytest.raises(ProtocolError, match="CommonMode needs one pair that drives"):
        model_of(protocol, (je.effects.CommonMode(),))
    with pytest.raises(ProtocolError, match="scan_time needs one pair"):
        je.scan.scan_time(protocol)
    image = je.Pixels(6).on(trigonometric)
    with pytest.raises(je.imaging.InverseError, match="hides the protocol"):
        jax.jit(lambda m: je.prepare(m, basis=image).factor)(trigonometric)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"current": CURRENT + 1}, "current of drive 0 sums to .* subtract its mean"),
        ({"current": 0 * CURRENT}, "current is zero in every drive"),
        ({"current": CURRENT * [1, 1, 0, 1]}, "current of drive 2 is zero; leave it out"),
        ({"current": CURRENT * np.nan}, "current has entries that are no finite real numbers"),
        ({"measurement": np.eye(COUNT)}, "measurement 0 of drive 0 sums to 1, .* give reference="),
        ({"measurement": np.eye(COUNT), "reference": 0}, "reference electrode alone"),
        ({"measurement": np.eye(COUNT), "reference": 9}, "electrodes are counted from 0 to 5"),
        ({"measurement": np.eye(5)}, r"has shape \(5, 5\); give a matrix with one row for each of the 6"),
        ({"measurement": [np.eye(COUNT)]}, "has 1 matrices for 4 drives"),
    ],
)
def test_wrong_matrices_are_refused(change, message):
    with pytest.raises(ProtocolError, match=message):
        je.Protocol.from_matrices(**{"current": CURRENT, "measurement": MEASURED["above the mean"]} | change)


def test_no_electrode_around_the_rim_is_refused():
    with pytest.raises(je.skin.ElectrodeError, match="0 electrodes around the rim; give 1 or more"):
        je.skin.rim_electrodes(DISC, 0)


@pytest.mark.slow
def test_rim_electrodes_are_where_they_are_asked_for():
    square = je.Polygon(np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]))
    top = je.skin.rim_electrodes(square, 8, 0.1, start=np.pi / 2, clockwise=True)
    middles = np.array([e.centre(square) for e in top])
    np.testing.assert_allclose(middles[:3], [[0, 1], [1, 1], [1, 0]], atol=1e-9)
    angles = [0.1, 2.0, 4.0]
    points = je.skin.rim_electrodes(DISC, angles, 0.0, start=0.3, clockwise=True)
    turned = 0.3 - np.array(angles)
    np.testing.assert_allclose(
        [p.position for p in points], 0.1 * np.stack([np.cos(turned), np.sin(turned)], 1), atol=1e-9
    )
    half = je.skin.rim_electrodes(DISC, 4)
    assert half[0].stop - half[0].start == pytest.approx(DISC.perimeter / 8)
    with pytest.raises(ElectrodeError, match="do not fit"):
        je.skin.rim_electrodes(DISC, [0.0, 0.1], 0.02)
    horseshoe = je.Polygon(np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3.0]]))
    with pytest.raises(ElectrodeError, match="must lie inside"):
        je.skin.rim_electrodes(horseshoe, 4)
