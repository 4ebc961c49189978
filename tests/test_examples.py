"""Every program of examples/ runs, and finds what it says."""

import runpy

import jax.numpy as jnp
import pytest

FINDS = {
    "forces_of_a_session": lambda names: names["found"]["force_rmse"] < 1,
    "gradient_of_a_loss": lambda names: jnp.abs(names["guess"] - jnp.array([0.07, 0.12, 0.5])).max() < 1e-3,
    "many_presses": lambda names: names["error"] < 0.015,
    "missing_readings": lambda names: names["changes"]["left out"] < 0.1 < names["changes"]["taken for zero"],
    "my_own_effect": lambda names: jnp.abs(names["wet"] - names["dry"]).max() > 0,
    "my_own_prior": lambda names: names["far"]["Near"] < 0.5 * names["far"]["Noser"],
    "one_effect_at_a_time": lambda names: (
        [change > 0 for change in names["largest"].values()] == [False, True, True, True]
    ),
    "tank": lambda names: jnp.linalg.norm(names["found"][:2] - names["middle"]) < 0.005,
    "uneven_coating": lambda names: (
        names["errors"]["fitted to the frame without contact"] < names["errors"]["assumed even"]
    ),
    "where_is_the_contact": lambda names: jnp.linalg.norm(names["found"][:2] - names["place"]) < 5e-4,
}
QUICK = {"missing_readings", "my_own_effect", "tank"}


def test_every_example_is_run_and_listed(root):
    files = {path.stem for path in (root / "examples").glob("*.py")}
    assert files == set(FINDS)
    page = (root / "examples" / "README.md").read_text(encoding="utf-8")
    assert all(f"({name}.py)" in page for name in files)


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in sorted(FINDS)]
)
def test_an_example_finds_what_it_says(root, name, capsys):
    names = runpy.run_path(str(root / "examples" / f"{name}.py"))
    assert FINDS[name](names)
    assert capsys.readouterr().out.count("\n") >= 1
