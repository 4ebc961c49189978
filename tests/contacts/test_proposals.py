"""Proposals of loads: a network in NumPy against one in JAX, missing readings against conditional means, and the fits
that begin where it says."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.contacts import LoadKind, Proposal, Proposed, load_proposal, shipped_proposal
from jaxeit.contacts.loads.learned.proposal import KINDS, MIN_READINGS, PARAMETERS, PROPOSALS, WEIGHTS, components
from jaxeit.contacts.loads.search import FrameSearch
from jaxeit.imaging import InverseError
from jaxeit.skin import parse_skin, skin_hash

from .touches import TOUCHES

READINGS, DIRECTIONS, PADS = 30, 6, 4


@pytest.fixture(scope="module")
def network():
    return eqx.nn.MLP(DIRECTIONS + 1 + 2 * PADS, KINDS + PARAMETERS, 16, 2, key=jax.random.key(1), dtype="float32")


@pytest.fixture(scope="module")
def proposal(network, skin):
    rng = np.random.default_rng(0)
    weights = [np.asarray(part) for layer in network.layers for part in (layer.weight, layer.bias)]
    return Proposal(
        noise=np.array(1e-5),
        basis=np.linalg.qr(rng.normal(size=(READINGS, DIRECTIONS)))[0],
        spread=np.linspace(30.0, 3.0, DIRECTIONS),
        mean=rng.normal(size=DIRECTIONS + 1),
        deviation=rng.uniform(0.5, 2, DIRECTIONS + 1),
        **dict(zip(WEIGHTS, weights, strict=True)),
        temperature=np.array(1.7),
        offset=rng.normal(size=PARAMETERS),
        scale=rng.uniform(1, 2, PARAMETERS),
        unexplained=np.array(0.02),
        limits=np.array([20.0, 2.0]),
        about={"skin": skin.name, "skin_sha256": skin_hash(skin)},
    )


def test_the_network_is_that_of_equinox(proposal, network):
    rng = np.random.default_rng(1)
    dv, forces = 1e-4 * rng.normal(size=(3, 2, READINGS)), rng.uniform(0, 30, (3, 2, PADS))
    forces[0, 0, 1] = np.nan
    found = proposal(dv, forces)
    z = dv / 1e-5 @ proposal.basis
    size = np.linalg.norm(z, axis=-1, keepdims=True)
    known = np.isfinite(forces)
    seen = (np.concatenate([z / size, np.log(size)], -1) - proposal.mean) / proposal.deviation
    x = np.concatenate([seen, np.where(known, np.log1p(np.nan_to_num(forces)), 0), known], -1)
    out = np.asarray(jax.vmap(jax.vmap(network))(jnp.asarray(x, "float32")), float)
    np.testing.assert_allclose(found.probability, jax.nn.softmax(out[..., :KINDS] / 1.7), atol=1e-5)
    loads = proposal.offset + proposal.scale * out[..., KINDS:]
    parts = [found.one, found.two, found.edge, found.more]
    np.testing.assert_allclose(np.concatenate([p.reshape(3, 2, -1) for p in parts], -1), loads, atol=1e-4)
    single = proposal(dv[1, 0], forces[1, 0])
    np.testing.assert_allclose(single.two, found.two[1, 0], atol=1e-4)
    assert single.kind == np.argmax(found.probability[1, 0])


def test_missing_readings_are_guessed_as_gaussian_processes_do(proposal):
    """The mean of the components given the readings that are there, from their joint covariance."""
    rng = np.random.default_rng(2)
    basis, spread = proposal.basis, proposal.spread
    d = (spread * rng.normal(size=(5, DIRECTIONS))) @ basis.T + rng.normal(size=(5, READINGS))
    d[1, :7], d[3, [2, 9]] = np.nan, np.nan
    z, left, count = components(d, basis, spread)
    prior = np.diag(spread**2)
    for k in (1, 3):
        there = np.isfinite(d[k])
        u = basis[there]
        expected = prior @ u.T @ np.linalg.solve(u @ prior @ u.T + np.eye(there.sum()), d[k, there])
        np.testing.assert_allclose(z[k], expected, rtol=1e-9)
        assert left[k] == pytest.approx(np.sum((d[k, there] - u @ z[k]) ** 2))
    np.testing.assert_array_equal(count, [30, 23, 30, 28, 30])
    np.testing.assert_allclose(z[0], d[0] @ basis)


def test_frames_unlike_the_training_are_announced(proposal):
    rng = np.random.default_rng(3)
    like = 1e-5 * ((proposal.spread * rng.normal(size=(50, DIRECTIONS))) @ proposal.basis.T)
    typical = replace(proposal, mean=np.zeros(DIRECTIONS + 1), deviation=np.ones(DIRECTIONS + 1))
    assert not typical(like + 1e-5 * rng.normal(size=like.shape)).outside
    assert typical(like[0] + 5e-5 * rng.normal(size=READINGS)).outside
    assert (replace(typical, limits=np.array([1e-3, 2.0]))(like).distance > 1).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200, -1e17])
@pytest.mark.parametrize("name", ["testbed", "chest"])
def test_a_frame_that_tells_nothing_is_outside_and_no_kind_is_certain(name, value):
    shipped = load_proposal(name)
    frames = np.zeros((2, len(shipped.basis)))
    frames[1] = value
    found = shipped(frames)
    np.testing.assert_array_equal(found.probability[1], np.full(KINDS, 1 / KINDS))
    np.testing.assert_array_equal(found.distance > 1, [False, True])
    assert found.probability[0].argmax() == LoadKind.NONE
    assert np.isfinite(found.more).all()


def test_a_few_readings_tell_no_kind(proposal):
    typical = replace(proposal, mean=np.zeros(DIRECTIONS + 1), deviation=np.ones(DIRECTIONS + 1))
    frame = 1e-4 * np.random.default_rng(6).normal(size=READINGS)
    frame[MIN_READINGS:] = np.nan
    enough = typical(frame)
    assert np.isfinite(enough.distance)
    frame[0] = np.nan
    few = typical(frame)
    assert few.outside
    assert np.ptp(few.probability) == 0 < np.ptp(enough.probability)


def test_a_file_gives_the_same_proposal(proposal, skin, tmp_path):
    path, dv = tmp_path / "proposal.npz", 1e-4 * np.random.default_rng(4).normal(size=READINGS)
    proposal.save(path)
    found = load_proposal(path)
    np.testing.assert_array_equal(found(dv).probability, proposal(dv).probability)
    with pytest.raises(InverseError, match="dv is a masked array"):
        found(np.ma.masked_invalid(dv))
    found.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()
    found.require_skin(skin)
    with pytest.raises(InverseError, match=r"trained for another skin \(testbed\) than chest; train one"):
        found.require_skin(je.load_skin("chest"))


@pytest.mark.parametrize(("name", "other"), [("testbed", "chest"), ("chest", "testbed")])
def test_shipped_proposals_are_small_and_for_their_skin_alone(name, other):
    found, ours = load_proposal(name), je.load_skin(name)
    assert (PROPOSALS / f"{name}.npz").stat().st_size < 600_000
    commented = parse_skin(f"# mine\n{ours.toml}")
    found.require_skin(commented)
    assert shipped_proposal(commented).about == found.about
    with pytest.raises(InverseError, match=rf"trained for another skin \({name}\) than {other}; train one"):
        found.require_skin(je.load_skin(other))
    assert shipped_proposal(replace(ours, sheet_resistance=99.0)) is None
    assert found(np.zeros(ours.protocol.readings)).kind is LoadKind.NONE


def test_what_is_no_proposal_is_refused(proposal, tmp_path):
    path = tmp_path / "proposal.npz"
    for changes, message in (
        ({"bias1": np.zeros(3, "f4")}, "do not fit"),
        ({"noise": np.array(0.0)}, "cannot be"),
        ({"scale": np.full(PARAMETERS, np.nan)}, "scale cannot be"),
    ):
        replace(proposal, **changes).save(path)
        with pytest.raises(InverseError, match=f"proposal.npz: .*{message}.*; train it again"):
            load_proposal(path)
    proposal.save(path)
    whole = path.read_bytes()
    for data in (b"", whole[:-500], whole[:200] + b"x" + whole[201:]):
        path.write_bytes(data)
        with pytest.raises(InverseError, match=r"proposal\.npz"):
            load_proposal(path)
    np.savez(path, about="{}")
    with pytest.raises(InverseError, match="is no proposal"):
        load_proposal(path)
    with pytest.raises(InverseError, match="for frames of 30 readings"):
        proposal(np.zeros(29))
    with pytest.raises(InverseError, match="one force to each of 4 pads"):
        proposal(np.zeros(30), np.zeros(3))


def proposed(kind, rows, distance=0.2):
    """A proposal of one kind whose loads lie some millimetres beside the true ones."""
    probability = np.full(KINDS, 1e-4)
    probability[kind] = 1 - 4e-4
    shift = np.array([0.003, -0.002])
    rows = [[*(place + shift), np.log(0.014), np.log(force)] for place, force in rows]
    blank = {
        "one": np.array([[0.1, 0.1, np.log(0.012), np.log(10.0)]]),
        "two": np.array([[0.08, 0.1, np.log(0.012), 2.0], [0.12, 0.1, np.log(0.012), 2.0]]),
        "edge": np.array([[0.1, 0.1, np.log(0.012), 2.0, 0.02, 0]]),
        "more": np.zeros((3, 4)),
    }
    loads = blank | ({kind.name.lower(): np.array(rows)} if rows else {})
    return Proposed(probability, **loads, distance=np.array(distance))


@pytest.mark.slow
def test_a_fit_from_a_proposal_ends_where_a_search_does(ready):
    fitter, finder, frames, _ = ready
    _, (places, forces) = TOUCHES["two at 30 mm"]
    number = list(TOUCHES).index("two at 30 mm")
    searched = fitter(frames[number], finder(frames[number]))
    found = fitter.refine(frames[number], proposed(LoadKind.TWO, zip(places, forces, strict=True)))
    assert found.kind is LoadKind.TWO
    assert found.edge is None
    assert found.more is None
    order = np.argsort(np.asarray(found.two.position)[:, 0])
    expected = np.asarray(searched.two.position)
    np.testing.assert_allclose(found.two.position[order], expected[np.argsort(expected[:, 0])], atol=1e-4)
    assert found.two.misfit == pytest.approx(float(searched.two.misfit), abs=0.02)


def test_a_proposal_that_leads_astray_is_not_followed(ready, monkeypatch):
    """Neither outside of its scenes, nor where what it proposes explains nothing."""
    fitter, finder, frames, _ = ready
    contacts, search, calls = finder(frames[0]), FrameSearch.search, []
    searched = fitter(frames[0], contacts)
    monkeypatch.setattr(FrameSearch, "search", lambda self: calls.append(self) or search(self))
    far = proposed(LoadKind.ONE, [(np.array([0.1, 0.1]), 10.0)], distance=1.5)
    np.testing.assert_array_equal(fitter.refine(frames[0], far, contacts).probability, searched.probability)
    right = proposed(LoadKind.ONE, [(np.array([0.09, 0.12]), 20.0)])
    np.testing.assert_allclose(fitter.refine(frames[0], right, contacts).one.position, searched.one.position, atol=1e-4)
    assert len(calls) == 1
    wrong = proposed(LoadKind.ONE, [(np.array([0.195, 0.005]), 200.0)])  # the fit finds the load from a nearer start
    found = fitter.refine(frames[0], wrong, contacts)
    assert len(calls) == 2
    np.testing.assert_allclose(found.one.position, searched.one.position, atol=1e-6)
    assert float(found.one.misfit) <= float(searched.one.misfit) + 1e-6


def test_frames_without_a_search_and_without_contact(ready):
    """Outside of its scenes a frame is searched from all over the sheet, and noise is nothing."""
    fitter, _, frames, noise = ready
    far = proposed(LoadKind.ONE, [(np.array([0.1, 0.1]), 10.0)], distance=1.5)
    found = fitter.refine(frames[0], far)
    assert found.kind is LoadKind.ONE
    assert np.linalg.norm(found.one.position[0] - np.array([0.09, 0.12])) < 0.002
    still = noise[0] * np.random.default_rng(5).normal(size=len(noise))
    assert fitter.refine(still, proposed(LoadKind.NONE, [])._replace(one=far.one)).kind is LoadKind.NONE
    with pytest.raises(InverseError, match="fit one frame"):
        fitter.refine(frames, far)
