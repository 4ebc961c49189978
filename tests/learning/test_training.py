"""Training of a proposal: what the network is told, that it learns, and that an interruption changes nothing."""

from concurrent.futures import ThreadPoolExecutor
from itertools import permutations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from calib.bench import BenchError, Footprint, RandomScenes
from calib.bench.training.random_scenes import draw_contacts
from calib.bench.training.scene_frames import SceneFrames
from calib.cli import main
from calib.learning import procedure, training
from calib.learning.procedure import train_proposal
from calib.learning.quality import fit_temperature
from calib.learning.scenes import SCENES, training_bench
from calib.learning.targets import targets_of
from jaxeit.contacts import LoadKind, load_proposal
from jaxeit.contacts.loads.learned.proposal import PARAMETERS

from ..helpers import skin_of


class Frames(dict):
    """Arrays of one drawn skin, as `calib.bench.TrainingFrames` hands them out."""


@pytest.fixture(scope="module")
def frames(skin):
    made = SceneFrames(training_bench(skin), je.Fidelity.draft(dtype="float32"), je.Pixels(4, 4), SCENES)
    return Frames(made.simulate(3, 1))


@pytest.mark.slow
def test_scenes_have_pairs_edges_and_skins_of_all_strengths(skin, frames):
    drawn = draw_contacts(SCENES, skin.domain, 4000, np.random.default_rng(0))
    there = np.arange(3) < drawn.number[:, None]
    assert skin.domain.contains(drawn.place.reshape(-1, 2)).all()
    alone = drawn.number == 1
    edges = (drawn.footprint[alone, 0] == Footprint.EDGE).mean()
    assert abs(edges - SCENES.footprints[3]) < 0.03
    assert abs((drawn.footprint[~alone][there[~alone]] == Footprint.EDGE).mean() - SCENES.together[3]) < 0.03
    assert (
        drawn.size[drawn.footprint == Footprint.EDGE].max()
        > 0.03
        > 0.015
        >= drawn.size[drawn.footprint == Footprint.DISC].max()
    )
    two = drawn.number >= 2
    apart = np.linalg.norm(drawn.place[two, 1] - drawn.place[two, 0], axis=1)
    assert (apart < SCENES.apart[1]).mean() > 0.65
    assert (drawn.place[~there] == 0).all()
    assert 0.005 <= frames["load_spread"][0] <= 0.02
    made = SceneFrames(training_bench(skin), je.Fidelity.draft(dtype="float32"), je.Pixels(4, 4), SCENES)
    assert made.simulate(4, 1, 4)["load_spread"][0] != frames["load_spread"][0]
    with pytest.raises(BenchError, match=r"near is 2, misplaced is 0\.0"):
        RandomScenes(near=2)


@pytest.mark.slow
def test_targets_are_the_contacts_or_their_moments(frames):
    found = targets_of(frames)
    order = np.argsort(-frames["contact_force"], axis=1)
    force, size, angle = (np.take_along_axis(frames[f"contact_{n}"], order, 1) for n in ("force", "size", "angle"))
    place = np.take_along_axis(frames["contact_place"], order[..., None], 1)
    force = np.where(force < 0.1 * force[:, :1], 0, force)
    number = (force > 0).sum(1)
    share = force / np.maximum(force.sum(1, keepdims=True), 1e-9)
    touched = number > 0
    np.testing.assert_allclose(found.loads[:, :2], np.einsum("nk,nkd->nd", share, place), atol=1e-6)
    np.testing.assert_allclose(np.exp(found.loads[touched, 3]), force[touched].sum(1), rtol=1e-5)
    two = found.kind == LoadKind.TWO
    pairs = two & (number == 2)
    np.testing.assert_allclose(found.loads[pairs][:, [4, 5, 8, 9]], place[pairs, :2].reshape(-1, 4), atol=1e-6)
    long = found.kind == LoadKind.EDGE
    size, angle = size[long, 0], angle[long, 0]
    assert (2 * size >= 0.024).all()
    half = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    np.testing.assert_allclose(found.loads[long, 16:18], half, atol=1e-6)
    halves = found.loads[long, 4:12].reshape(-1, 2, 4)[..., :2]
    away = np.linalg.norm(halves[:, 0] - halves[:, 1], axis=1)
    np.testing.assert_allclose(away, 2 / np.sqrt(3) * size, rtol=1e-4)  # their second moment is that of the edge
    near = (number == 2) & (np.linalg.norm(place[:, 1] - place[:, 0], axis=1) < 0.018)
    assert near.any()
    assert (found.kind[near] == LoadKind.ONE).all()
    assert set(found.kind[number == 0]) == {LoadKind.NONE}
    assert (frames["contacts"] > number).any()  # a contact beside one ten times as strong


def test_the_order_of_loads_does_not_count():
    rng = np.random.default_rng(0)
    true, found = (jnp.asarray(rng.normal(size=(4, PARAMETERS)), "float32") for _ in range(2))
    unit = jnp.ones(PARAMETERS, "float32")
    errors = training.load_errors(found, true, unit)
    swapped = np.array(true)
    swapped[:, 4:12] = swapped[:, [8, 9, 10, 11, 4, 5, 6, 7]]
    swapped[:, 16:18] *= -1
    swapped[:, 18:] = swapped[:, 18:].reshape(4, 3, 4)[:, [2, 0, 1]].reshape(4, 12)
    np.testing.assert_allclose(training.load_errors(found, jnp.asarray(swapped), unit), errors, rtol=1e-6)
    np.testing.assert_array_equal(training.load_errors(true, jnp.asarray(swapped), unit), 0)
    three, other = (np.asarray(part)[:, 18:].reshape(4, 3, 4) for part in (found, true))
    each = [np.sum(np.sqrt(1 + (three - other[:, list(o)]) ** 2) - 1, 2).mean(1) for o in permutations(range(3))]
    np.testing.assert_allclose(errors[:, 3], np.min(each, 0), rtol=1e-5)


def test_probabilities_are_tempered():
    """Log odds that are three times too sure."""
    rng = np.random.default_rng(1)
    logs = rng.normal(size=(20_000, 5))
    odds = np.exp(logs) / np.exp(logs).sum(1, keepdims=True)
    kind = (odds.cumsum(1) < rng.random((len(odds), 1))).sum(1)
    assert fit_temperature(3 * logs, kind) == pytest.approx(3, rel=0.05)


def examples(rng, count=2048):
    x = rng.normal(size=(count, 7)).astype("float32")
    kind = (x[:, 0] > 0).astype("int32")
    loads = np.zeros((count, PARAMETERS), "float32")
    loads[:, 0] = x[:, 1]
    known = np.zeros((count, 4), "float32")
    known[:, 0] = 1
    parts = (x, x, np.zeros((count, 2), "float32"), kind, loads, known)
    return training.Examples(*map(jnp.asarray, parts))


def test_an_interruption_changes_nothing(tmp_path):
    data, unit = examples(np.random.default_rng(0)), np.full(PARAMETERS, 0.1, "float32")
    whole = training.train(data, unit, 6, 1, tmp_path / "whole", lambda done: None)

    def stop(done):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        training.train(data, unit, 6, 1, tmp_path / "part", stop)
    done = []
    again = training.train(data, unit, 6, 1, tmp_path / "part", done.append)
    assert done == [3, 4, 5, 6]
    assert eqx.tree_equal(whole, again)
    out = jax.vmap(whole)(
        jnp.concatenate([data.whole, jnp.zeros((2048, 2), "float32"), jnp.ones((2048, 2), "float32")], 1)
    )
    assert (np.asarray(out)[:, :2].argmax(1) == np.asarray(data.kind)).mean() > 0.9


DAMAGE = (lambda whole: b"", lambda whole: whole[:-9], lambda whole: whole[:-4] + b"\xff" * 4)


@pytest.mark.parametrize("damaged", DAMAGE)
def test_a_damaged_checkpoint_is_refused(tmp_path, damaged):
    data, unit, path = examples(np.random.default_rng(0), 256), np.full(PARAMETERS, 0.1, "float32"), tmp_path / "c"
    training.train(data, unit, 1, 1, path, lambda done: None)
    path.write_bytes(damaged(path.read_bytes()))
    with pytest.raises(BenchError, match="is damaged; remove it"):
        training.train(data, unit, 2, 1, path, lambda done: None)


def test_weights_that_are_no_numbers_are_not_kept(tmp_path):
    data, path = examples(np.random.default_rng(0), 256), tmp_path / "c"
    unit = np.full(PARAMETERS, np.nan, "float32")
    with pytest.raises(BenchError, match="no numbers after epoch 1"):
        training.train(data, unit, 2, 1, path, lambda done: None)
    assert not path.exists()


@pytest.fixture
def small(monkeypatch):
    """A skin of six electrodes, few frames, and one thread in place of processes."""
    monkeypatch.setattr(procedure, "MIN_SHARDS", 4)
    monkeypatch.setattr(procedure, "TRAINED", 0.5)
    monkeypatch.setattr(procedure, "TUNED", 0.75)
    places = [(0.02, 0.02), (0.08, 0.02), (0.08, 0.08), (0.02, 0.08), (0.05, 0.02), (0.05, 0.08)]
    electrodes = [je.PointElectrode(place) for place in places]
    return skin_of(je.Rectangle(0.1, 0.1), electrodes, je.skin.adjacent(6))


@pytest.mark.slow
def test_a_proposal_is_trained_again_to_the_same_bytes(small, tmp_path):
    """After an interruption in the midst of the epochs; nothing but the file is left."""
    options = {"frames": 4 * 1024, "epochs": 3, "seed": 5, "executor": ThreadPoolExecutor(1)}
    paths = [tmp_path / name for name in ("first.npz", "second.npz")]
    train_proposal(small, paths[0], **options)
    seen = []

    def stop(stage, done, of):
        seen.append((stage, done, of))
        if seen[-1] == ("epochs", 2, 3):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_proposal(small, paths[1], progress=stop, **options)
    assert ("skins", 4, 4) in seen
    seen.clear()
    train_proposal(small, paths[1], progress=lambda *at: seen.append(at), **options)
    assert seen == [("epochs", 3, 3)]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first.npz", "second.npz"]
    found = load_proposal(paths[1])
    found.require_skin(small)
    assert found.pads == 0
    assert found.about["seed"] == 5
    assert found.about["scenes"]["drawn_from"]["near"] == SCENES.near
    assert 0 < found.about["held_out"]["kinds_told"] < 1
    assert found(np.zeros(len(found.basis))).kind is LoadKind.NONE


def test_what_cannot_be_trained_is_said_first(tmp_path, monkeypatch, capsys):
    out = str(tmp_path / "p.npz")
    with pytest.raises(BenchError, match="1000 frames are too few to hold skins out; give 8,192 or more"):
        train_proposal(je.load_skin("testbed"), out, frames=1000)
    assert main(["train", "testbed", "-o", out, "--frames", "1000"]) == 2
    assert main(["train", "nowhere", "-o", out]) == 2
    assert main(["apply", "c.h5", "s.h5", "-o", out, "--proposal", out]) == 2
    assert "add --loads SECONDS" in capsys.readouterr().err
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["train", "testbed", "-o", out]) == 2
    assert "pip install 'jaxeit[train]'" in capsys.readouterr().err
