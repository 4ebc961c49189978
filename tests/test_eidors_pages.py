"""What the pages let users of EIDORS write runs in EIDORS itself, under GNU Octave; the numbers are ours."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.io import loadmat

import calib
import jaxeit as je
from benchmarks.peers.eidors import missing, run_program

from .tanks.rods import PLACE, RADIUS, tank_with_rod
from .tanks.tank_files import change_on_mesh, write_csv
from .test_docs import blocks, run
from .test_tutorials import close

WHY = missing() or (None if shutil.which("gnuplot") else "gnuplot, with which Octave draws, is not on PATH")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(WHY is not None, reason=str(WHY))]
BEGIN = """
save_default_options('-mat7-binary');  % that of MATLAB
"""
TANK = """
elem_data = change.elem_data; fmdl = imdl.fwd_model; save('change.mat', 'elem_data', 'fmdl', 'vh', 'vi')
"""
END = """
elem_data = rec.elem_data; save('image.mat', 'elem_data')
"""


def matlab(page):
    """The programs of a page in the language of MATLAB."""
    return [text for language, _, text in blocks(page) if language == "matlab"]


@pytest.fixture(scope="module")
def folder(root, tmp_path_factory):
    """A folder with what the programs of both pages save; the last ones go on from a model `fmdl` of the reader."""
    folder = tmp_path_factory.mktemp("eidors")
    (task,) = matlab(root / "docs" / "from-eidors.md")
    recorded, with_model, without = matlab(root / "docs" / "tanks.md")
    write_csv(folder / "tank_55uA_1000Hz.csv", tank_with_rod().frames)
    script = "".join([BEGIN, recorded, TANK, task, "fmdl = imdl.fwd_model;\n", with_model, without, END])
    done = run_program(folder, script)
    assert (folder / "image.mat").exists(), done.stdout + done.stderr
    return folder


def test_the_page_on_tanks_reads_what_eidors_saves(root, folder, monkeypatch):
    monkeypatch.chdir(folder)
    programs = [text for language, _, text in blocks(root / "docs" / "tanks.md") if language == "python"]
    (program,) = [text for text in programs if 'load_tank("tank.mat")' in text]
    names = {"calib": calib, "je": je}
    exec(compile(program, "tanks.md", "exec"), names)
    tank, found = names["tank"], names["found"]
    assert tank.names == ("vh", "vi")
    assert found.correlation == pytest.approx(1)
    place = je.LevelCentroid(0.5)(jnp.asarray(found.change), found.recon)
    np.testing.assert_allclose(place, [0.3, 0.4], atol=0.05)
    alone = calib.tanks.load_tank("frames.mat", skin=tank.skin)
    np.testing.assert_array_equal(alone.frames, tank.frames)


def test_eidors_itself_gives_the_same_voltages_and_the_same_image(root, folder):
    """By the hyperparameter that the page takes over."""
    tank = calib.tanks.load_tank(folder / "tank.mat")
    model = tank.model()
    vh, vi = tank.frames
    close(je.forward(model), vh)
    taken_over = run(root / "docs" / "from-eidors.md", {})["from_eidors"](model, 0.03, je.Elements())
    recon = je.prepare(model, je.Noser(), basis=je.Elements(), hyperparameter=taken_over)
    close(recon(vi - vh), loadmat(folder / "image.mat")["elem_data"].ravel())


def test_eidors_itself_shows_the_same_change_in_the_file_of_a_tank(root, folder):
    own = calib.tanks.load_tank(folder / "change.mat")
    model = own.model()
    weight = run(root / "docs" / "from-eidors.md", {})["from_eidors"](model, 3e-4, je.Elements())
    assert weight == pytest.approx(0.3, rel=0.05)  # as the page says
    theirs = loadmat(folder / "change.mat")["elem_data"].ravel()
    close(change_on_mesh(folder / "tank_55uA_1000Hz.csv", own.mesh, own.skin.electrodes, weight), theirs)
    highest = np.asarray(model.centroids)[np.argmax(theirs)]
    x, y = PLACE / RADIUS  # counter-clockwise from +x; those of EIDORS are clockwise from +y
    np.testing.assert_allclose(highest, [y, x], atol=0.15)
