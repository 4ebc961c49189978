"""The tutorials for users of other programs, and the one on training, do what they say."""

from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je

from .tanks.rods import PLACE, RADIUS, tank_with_rod
from .tanks.tank_files import change_on_mesh, write_csv
from .test_docs import blocks, run


@pytest.fixture(scope="module")
def eidors(root):
    return run(root / "docs" / "from-eidors.md", {})


@pytest.fixture(scope="module")
def pyeit(root):
    return run(root / "docs" / "from-pyeit.md", {})


def one_step(jacobian, dv, weight, exponent):
    """``(J^T J + weight R)^-1 J^T dv`` with R = diag(J^T J)^exponent, as both programs write it."""
    prior = jnp.diag(jnp.sum(jacobian**2, 0) ** exponent)
    return jnp.linalg.solve(jacobian.T @ jacobian + weight * prior, jacobian.T @ dv)


def close(found, expected):
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow
def test_a_disc_as_in_eidors(eidors):
    assert eidors["vh"].shape == (208,)
    assert (eidors["vh"] > 0).all()  # the polarity of '{ad}', '{ad}'
    assert eidors["rows"][:2].tolist() == [[1, 0, 2, 3], [1, 0, 3, 4]]
    assert eidors["rows"][13:15].tolist() == [[2, 1, 3, 4], [2, 1, 4, 5]]  # the sense pairs do not rotate
    assert eidors["rows"][26:28].tolist() == [[3, 2, 0, 1], [3, 2, 4, 5]]
    np.testing.assert_array_equal(je.skin.named_pattern("eidors-adjacent", 16), eidors["rows"])
    assert eidors["picture"].shape == (32, 32)
    place = je.LevelCentroid(0.5)(eidors["image"], eidors["recon"])
    np.testing.assert_allclose(place, [0.3, 0.4], atol=0.05)


def test_a_hyperparameter_of_eidors_is_taken_over(eidors):
    dv = eidors["vi"] - eidors["vh"]
    close(eidors["elem_data"], one_step(je.jacobian(eidors["model"]), dv, 0.03**2, 0.5))


def test_normalised_differences_are_a_weight(eidors):
    model, vh, vi = eidors["model"], eidors["vh"], eidors["vi"]
    weighed = je.prepare(model, basis=je.Elements(), noise=jnp.abs(vh), hyperparameter=0.1)
    jacobian = je.jacobian(model) / vh[:, None]
    weight = 0.1**2 * jnp.sum(jnp.sqrt(jnp.sum(jacobian**2, 0))) / len(vh)
    close(weighed(vi - vh), one_step(jacobian, vi / vh - 1, weight, 0.5))


def test_the_order_of_rotated_readings_is_ours():
    drive, step = np.divmod(np.arange(16 * 16), 16)
    sense = (drive + step) % 16  # 'rotate_meas' begins at the driven electrode
    kept = ~np.isin(step, (0, 1, 15))
    rotated = np.stack([drive, (drive + 1) % 16, sense, (sense + 1) % 16], 1)[kept]
    np.testing.assert_array_equal(je.skin.adjacent(16), rotated)


def test_a_disc_as_in_pyeit(pyeit):
    assert pyeit["v0"].shape == (208,)
    assert (pyeit["v0"] > 0).all()
    model, dv = pyeit["model"], pyeit["v1"] - pyeit["v0"]
    place = jnp.average(model.centroids, axis=0, weights=jnp.maximum(pyeit["ds"], 0) * model.areas)
    np.testing.assert_allclose(place, [0.3, 0.4], atol=0.1)
    for exponent in (0.2, 0.5):
        weight = pyeit["from_pyeit"](model, 0.01, exponent)
        recon = je.prepare(model, je.Noser(exponent=exponent), basis=je.Elements(), hyperparameter=weight)
        close(recon(dv), one_step(je.jacobian(model), dv, 0.01, exponent))
    nodes = [int(jnp.argmin(jnp.linalg.norm(model.nodes - jnp.array(e.position), axis=1))) for e in pyeit["electrodes"]]
    again = pyeit["on_mesh"](np.asarray(model.nodes), np.asarray(model.triangles), nodes)
    close(je.forward(again), pyeit["v0"])


def with_pyeit(root, page, title):
    """What a program of a page, for pyEIT, defines."""
    (program,) = [text for _, name, text in blocks(root / "docs" / page) if name == title]
    names: dict = {}
    exec(compile(program, title, "exec"), names)
    return names


needs_pyeit = pytest.mark.skipif(find_spec("pyeit") is None, reason="the extra bench is not installed")


@pytest.mark.slow
@needs_pyeit
@pytest.mark.filterwarnings("ignore")  # of another program
def test_pyeit_itself_gives_the_same_voltages_and_the_same_image(pyeit, root):
    theirs = with_pyeit(root, "from-pyeit.md", "with_pyeit.py")
    mesh = theirs["mesh_obj"]
    model = pyeit["on_mesh"](mesh.node, mesh.element, mesh.el_pos)
    v0, v1 = je.forward(model), je.forward(model, jnp.asarray(np.real(theirs["touched"].perm)))
    close(v0, np.real(theirs["v0"]))
    close(v1, np.real(theirs["v1"]))
    weight = pyeit["from_pyeit"](model, 0.01, 0.5)
    recon = je.prepare(model, je.Noser(exponent=0.5), basis=je.Elements(), hyperparameter=weight)
    close(recon(v1 - v0), np.real(theirs["ds"]))


@pytest.mark.slow
@needs_pyeit
@pytest.mark.filterwarnings("ignore")  # of another program
def test_pyeit_itself_shows_the_same_change_in_the_file_of_a_tank(pyeit, root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_csv(tmp_path / "tank_55uA_1000Hz.csv", tank_with_rod().frames)
    theirs = with_pyeit(root, "tanks.md", "tank_with_pyeit.py")
    mesh, change = theirs["mesh_obj"], np.real(theirs["change"])
    model = pyeit["on_mesh"](mesh.node, mesh.element, mesh.el_pos)
    weight = pyeit["from_pyeit"](model, 0.0016, 0.5)
    assert weight == pytest.approx(0.3, rel=0.02)  # as the page says
    electrodes = tuple(je.PointElectrode(tuple(place)) for place in mesh.node[mesh.el_pos, :2].tolist())
    close(change_on_mesh(path, model.mesh, electrodes, weight), change)
    highest = np.asarray(model.centroids)[np.argmax(change)]
    x, y = PLACE / RADIUS  # counter-clockwise from +x; those of pyEIT are clockwise from -x
    np.testing.assert_allclose(highest, [-x, y], atol=0.15)


@pytest.mark.slow
def test_a_network_trained_on_drawn_skins_is_nearer_than_the_image(root, capsys):
    names = run(root / "docs" / "train.md", {})
    assert names["dv"].shape == (3000, 550)
    assert bool(jnp.isfinite(names["dv"]).all())
    assert float(names["error"]) < 0.003
    assert float(names["error"]) < 0.8 * float(names["of_images"])
    assert "error of the place: network" in capsys.readouterr().out
