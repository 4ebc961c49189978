"""Every program of examples/ runs, and finds what it says."""

import json
import runpy

import jax.numpy as jnp
import pytest

from benchmarks.gallery import DRAWN
from benchmarks.notebooks import PICTURES, cells_of

FINDS = {
    "bending": lambda names: (
        names["changes"]["rolled, radius 50 mm"] < 0.005 < 0.01 < names["changes"]["on a ball, radius 200 mm"]
    ),
    "design_a_scan": lambda names: (
        names["design"].bound < 1e-3 * names["errors"]["designed, 100"] < 0.8e-3 * names["errors"]["shipped, 550"]
    ),
    "electrodes_that_move": lambda names: (
        jnp.linalg.norm(names["change"] - names["linear"]) < 0.1 * jnp.linalg.norm(names["change"])
    ),
    "end_to_end_regressor": lambda names: (
        names["errors"][400] < 0.9 * names["errors"][0] < 0.2
        and names["wrong"]["network"] < 0.3 < 0.33 < names["wrong"]["image"]
    ),
    "forces_of_a_session": lambda names: names["found"]["force_rmse"] < 1,
    "gradient_of_a_loss": lambda names: jnp.abs(names["guess"] - jnp.array([0.07, 0.12, 0.5])).max() < 1e-3,
    "image_and_forces": lambda names: jnp.abs(names["on_pads"] - names["forces"]).max() < 1e-9,
    "many_presses": lambda names: names["error"] < 0.015,
    "mesh_of_my_own": lambda names: 0.001 < names["change"] < 0.02,
    "missing_readings": lambda names: names["changes"]["left out"] < 0.1 < names["changes"]["taken for zero"],
    "mujoco_ball_on_chest": lambda names: (
        names["rms"] < 0.8 and names["place"] < 0.003 and abs(names["finger"] - names["touched"][-1].force[1]) < 0.8
    ),
    "my_own_effect": lambda names: jnp.abs(names["wet"] - names["dry"]).max() > 0,
    "my_own_prior": lambda names: names["far"]["Near"] < 0.5 * names["far"]["Noser"],
    "noise_of_an_image": lambda names: names["apart"] < 0.1,
    "one_effect_at_a_time": lambda names: (
        [change > 0 for change in names["largest"].values()] == [False, True, True, True]
    ),
    "one_two_or_an_edge": lambda names: (
        all(max(stated, key=stated.get) == name for name, stated in names["probabilities"].items())
        and max(names["errors"].values()) < 5
    ),
    "pressure_to_force": lambda names: (
        names["errors"]["power"] < 0.05 < names["errors"]["linear"] and bool(names["found"].valid.all())
    ),
    "reciprocity": lambda names: names["found"]["sound"] < 1e-12 < 1e-3 < names["found"]["two readings swapped"],
    "sharpness": lambda names: names["errors"].max() < 0.006,
    "strength_of_the_prior": lambda names: (
        names["figures"]["0.1"][0] < 0.6 * names["figures"]["weak, 0.001"][0]
        and names["figures"]["0.1"][0] < 0.8 * names["figures"]["strong, 10"][0]
    ),
    "tank": lambda names: jnp.linalg.norm(names["found"][:2] - names["middle"]) < 0.005,
    "train_on_random_scenes": lambda names: names["errors"]["network"] < 0.3 < 0.35 < names["errors"]["fused image"],
    "two_fingers": lambda names: names["valleys"][20] > 0.9 and names["valleys"][80] < 0.1,
    "uneven_coating": lambda names: (
        names["errors"]["fitted to the frame without contact"] < names["errors"]["assumed even"]
    ),
    "where_is_the_contact": lambda names: jnp.linalg.norm(names["found"][:2] - names["place"]) < 5e-4,
    "which_readings": lambda names: names["shares"]["chosen"] > 0.7 > 0.5 > names["shares"]["at random"],
    "write_a_session": lambda names: names["pressures"].shape == (1000, 2) and names["forces"].max() > 14.9,
}
QUICK = {
    "bending",
    "image_and_forces",
    "missing_readings",
    "my_own_effect",
    "noise_of_an_image",
    "reciprocity",
    "tank",
    "write_a_session",
}


def test_every_example_is_run_and_listed(root):
    files = {path.stem for path in (root / "examples").glob("*.py")}
    assert files == set(FINDS)
    page = (root / "examples" / "README.md").read_text(encoding="utf-8")
    assert all(f"({name}.py)" in page for name in files)
    assert files == set(DRAWN) == {path.stem for path in (root / "docs" / "examples").glob("*.png")}
    for name in files:
        lines = (root / "examples" / f"{name}.py").read_text(encoding="utf-8").splitlines()
        assert len(lines) <= 60, name
        assert "?" in lines[0], name
        assert f"(../docs/examples/{name}.png)" in page


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in sorted(FINDS)]
)
def test_an_example_finds_what_it_says(root, name, capsys):
    if name.startswith("mujoco"):
        pytest.importorskip("mujoco")
    names = runpy.run_path(str(root / "examples" / f"{name}.py"))
    assert FINDS[name](names)
    assert capsys.readouterr().out.count("\n") >= 1


@pytest.mark.parametrize("name", PICTURES)
def test_notebooks_are_the_examples_with_a_picture(root, name):
    """`python -m benchmarks.notebooks` writes them."""
    notebook = json.loads((root / "examples" / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))
    head, *cells = notebook["cells"]
    question, program = cells_of(name)
    assert question in head["source"]
    assert [cell["source"] for cell in cells] == [*program, PICTURES[name]]
    assert "image/png" in cells[-1]["outputs"][-1]["data"]
    page = (root / "examples" / "README.md").read_text(encoding="utf-8")
    assert f"(notebooks/{name}.ipynb)" in page
