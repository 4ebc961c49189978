"""The Python programs of the documentation run as they stand."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je


def run(page, names):
    """Execute the programs of a page one after the other, and return what they defined."""
    for program in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
        exec(compile(program, page.name, "exec"), names)
    return names


def test_programs_about_curves(root):
    names = run(root / "docs" / "fitting.md", {"calib": calib, "np": np})
    np.testing.assert_allclose(names["force"], 2e-3 * names["pressure"] ** 1.1, rtol=1e-5)


def test_programs_about_import(root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("time,load\n" + "".join(f"{k / 100},{k % 7}\n" for k in range(100)))
    run(root / "docs" / "import.md", {})
    with calib.open_session("session.h5") as session:
        assert session.streams["force"].read()[:, 0].tolist() == [k % 7 for k in range(100)]


@pytest.mark.slow
def test_programs_about_images(root, model):
    place = jnp.array([0.06, 0.13])
    distance = jnp.linalg.norm(model.centroids - place, axis=1)
    v0 = je.forward(model)
    dv = je.forward(model, model.background * (1 + 0.5 * (distance < 0.01))) - v0
    noise = jnp.full(len(v0), 1e-4 * float(jnp.abs(v0).max()))
    given = {"je": je, "jnp": jnp, "model": model, "v0": v0, "dv": dv, "noise": noise, "distance": distance}
    names = run(root / "docs" / "methods.md", given | {"finder": je.prepare_contacts(model, noise=noise)})
    assert abs(float(names["figures"].position_error)) < 0.01
    assert 0.3 < float(names["likeness"]) <= 1
    assert float(je.localisation_error(je.contacts.strongest(names["contacts"]), place)) < 0.01
