"""A reconstructor as a file: the same numbers back, or one clear line."""

import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxeit as je

LATER = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxeit as je
recon = je.load_reconstructor(sys.argv[1])
print(repr(float(np.asarray(recon(np.linspace(-1e-4, 1e-4, 550)))[7])))
"""


@pytest.fixture(scope="module")
def recon(model):
    return je.prepare(model, basis=je.Pixels(12), noise=np.full(550, 1e-5), provenance={"skin": "testbed"})


@pytest.fixture
def path(recon, tmp_path):
    je.save_reconstructor(recon, tmp_path / "recon.npz")
    return tmp_path / "recon.npz"


def test_it_comes_back_as_it_was(recon, path):
    back = je.load_reconstructor(path)
    assert dict(back.provenance) == dict(recon.provenance)
    assert back.provenance["skin"] == "testbed"
    assert "Noser" in back.provenance["prior"]
    assert jax.tree.structure(back) == jax.tree.structure(recon)
    for ours, theirs in zip(jax.tree.leaves(back), jax.tree.leaves(recon), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    assert os.listdir(path.parent) == ["recon.npz"]


def test_another_process_gives_the_same_image(recon, path):
    done = subprocess.run([sys.executable, "-c", LATER, str(path)], capture_output=True, text=True, check=True)
    here = np.asarray(recon(np.linspace(-1e-4, 1e-4, 550)))[7]
    assert float(done.stdout) == pytest.approx(float(here), rel=1e-12)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (je.imaging.GaussianSmooth(length=0.01), je.imaging.GaussianSmooth(length=0.013, nugget=2e-3)),
        (je.Noser(floor=1e-3), je.Noser(floor=2e-3)),
    ],
)
def test_another_setting_of_a_prior_compiles_nothing_anew(model, pixels, compilations, one, other):
    je.prepare(model, one, basis=pixels)
    before = len(compilations)
    found = je.prepare(model, other, basis=pixels)
    assert len(compilations) == before
    assert found.provenance["prior"] != je.prepare(model, one, basis=pixels).provenance["prior"]


def test_another_provenance_compiles_nothing_anew(recon, compilations):
    dv = np.zeros(550)
    recon(dv)
    other = je.imaging.from_numbers(je.imaging.to_numbers(recon), recon.shape, recon.extent, {"skin": "another"})
    before = len(compilations)
    other(dv)
    assert len(compilations) == before


def test_single_precision_is_the_same_image_to_single_precision(recon):
    dv = 1e-4 * np.random.default_rng(0).normal(size=(5, 550))
    single = recon.astype("float32")
    assert single(dv).dtype == np.float32
    exact = np.asarray(recon(dv))
    np.testing.assert_allclose(single(dv), exact, atol=2e-6 * np.abs(exact).max())


@pytest.mark.parametrize("cut", [0, 1, 30, 1000, -1])
def test_a_cut_file_is_refused(path, cut):
    whole = path.read_bytes()
    path.write_bytes(whole[:cut] if cut >= 0 else whole[:-1000])
    with pytest.raises(je.imaging.StorageError, match=r"^recon\.npz: ") as caught:
        je.load_reconstructor(path)
    assert "\\n" not in str(caught.value)


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(je.imaging.StorageError, match=r"none\.npz: No such file"):
        je.load_reconstructor(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with pytest.raises(je.imaging.StorageError, match=r"other\.npz: is damaged or no reconstructor"):
        je.load_reconstructor(tmp_path / "other.npz")
    np.savez(tmp_path / "new.npz", about=np.array(json.dumps({"format": "jaxeit reconstructor 2"})))
    with pytest.raises(je.imaging.StorageError, match="this version reads"):
        je.load_reconstructor(tmp_path / "new.npz")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("factor", None, "factor: missing"),
        ("areas", np.ones(144, "f4"), "areas: is of type float32, and predict of type float64"),
        ("factor", np.ones((144, 299)), "predict: has shape"),
        ("predict", np.full((300, 300), np.nan), "predict: holds values that are not finite"),
        ("pairs", np.full((550, 4), 300), "pairs: must count the 300"),
        ("channels", np.ones(3, bool), "channels: has shape"),
        ("weight", np.ones((550, 3)), "weight: has shape"),
        ("centres", np.ones((144, 3)), "centres: has shape"),
        ("current", np.ones(2), "current: has shape"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(recon, name, value, message):
    numbers = je.imaging.to_numbers(recon)
    numbers = {k: v for k, v in numbers.items() if k != name} | ({} if value is None else {name: value})
    with pytest.raises(je.imaging.StorageError, match=message):
        je.imaging.from_numbers(numbers, recon.shape, recon.extent)


def test_a_picture_that_does_not_hold_the_image_is_refused(recon):
    with pytest.raises(je.imaging.StorageError, match="does not hold 144"):
        je.imaging.from_numbers(je.imaging.to_numbers(recon), (3, 3), recon.extent)


def test_a_file_of_another_kind_is_not_replaced(recon, tmp_path):
    path = tmp_path / "session.h5"
    path.write_bytes(b"\x89HDF a recording")
    with pytest.raises(je.imaging.StorageError, match=r"session.h5: holds something else than arrays, .* another name"):
        je.save_reconstructor(recon, path)
    assert path.read_bytes() == b"\x89HDF a recording"
    for _ in range(2):  # also in the place of an earlier one
        je.save_reconstructor(recon, tmp_path / "recon.npz")


def test_nothing_is_left_where_nothing_can_be_written(recon, tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match="directory"):
        je.save_reconstructor(recon, tmp_path / "taken")
    assert os.listdir(tmp_path) == ["taken"]
