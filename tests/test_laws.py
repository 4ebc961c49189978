"""The laws of the architecture, held from the source itself."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import calib
import jaxeit as je

ROOT = Path(__file__).parents[1]
ORDER = [
    "toml", "verbs", "lapack", "surface", "domain", "grading", "smoothing", "triangles", "footprints", "mesh",
    "elements", "electrodes", "protocol", "skin", "solvers", "effects", "scene", "fidelity", "coat", "discretise",
    "forward", "pneumatics", "stiffness", "basis", "jacobian", "whitening", "host", "gaps", "priors", "methods",
    "hyperparameter", "inverse", "store", "responses", "descent", "contacts", "refine", "optimise", "nonlinear",
    "background", "fusion", "metrics", "regions", "adaptive", "choices", "rungs", "ladder",
]  # fmt: skip
BENCH = [
    "session", "units", "choice", "corrections", "presses", "curves", "solver", "fit", "response", "smooth", "taxels",
    "location", "locators", "hybrid", "splits", "online", "measured", "loops", "evaluation", "calibration", "maps",
    "acquisition", "bench", "check", "importers", "logs", "figures", "ladder_figure", "report", "runtime", "workers",
    "batch", "cluster", "cli",
]  # fmt: skip


def _imports(path, package):
    """Modules of ``package`` that a file imports, at any depth of the file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            name = node.module or ""
            if node.level == 0 and name.split(".")[0] == package:
                yield [*name.split("."), ""][1]
            elif node.level and path.is_relative_to(ROOT / package):
                depth = len(path.relative_to(ROOT / package).parts) - node.level
                if depth == 0:
                    yield from [name.split(".")[0]] if name else (alias.name for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ([*a.name.split("."), ""][1] for a in node.names if a.name.split(".")[0] == package)


def _room(path, package):
    return path.relative_to(ROOT / package).parts[0].removesuffix(".py")


@pytest.mark.parametrize(("package", "order"), [("jaxeit", ORDER), ("calib", BENCH)])
def test_imports_run_down_the_list(package, order):
    for path in sorted((ROOT / package).rglob("*.py")):
        room = _room(path, package)
        if room == "__init__":
            continue
        assert room in order, f"{path}: give the new module its place in this test"
        for used in _imports(path, package):
            if used and used != room:
                assert order.index(used) < order.index(room), f"{path} imports {used}"


def test_jaxeit_knows_nothing_of_calib_or_files():
    for path in (ROOT / "jaxeit").rglob("*.py"):
        assert not list(_imports(path, "calib")), path
        assert not list(_imports(path, "h5py")), path
        assert "import h5py" not in path.read_text(), path


def test_only_the_session_package_touches_hdf5():
    users = {_room(p, "calib") for p in (ROOT / "calib").rglob("*.py") if "import h5py" in p.read_text()}
    assert users == {"session"}


def test_only_the_command_line_touches_the_configuration_of_jax():
    for package in ("jaxeit", "calib"):
        for path in (ROOT / package).rglob("*.py"):
            if _room(path, package) != "runtime":
                assert not re.search(r"^ *jax\.config\.", path.read_text(), re.MULTILINE), path


def test_factors_and_solves_are_those_that_are_safe_under_vmap():
    """See `jaxeit.lapack`. What is done once, on the host, may be JAX's."""
    theirs = r"from jax\.scipy\.linalg|\b(?:jnp|jsp|lax|jax\.scipy)\.linalg\.(?!norm)\w+(?=[(,)])"
    found = {
        (str(path.relative_to(ROOT)), name)
        for package in ("jaxeit", "calib")
        for path in (ROOT / package).rglob("*.py")
        for name in re.findall(theirs, path.read_text())
    }
    own = {"jaxeit/lapack.py", "jaxeit/solvers/nested_dissection.py"}
    assert {(path, name) for path, name in found if path not in own} == {
        ("jaxeit/methods.py", "jnp.linalg.qr"),
        ("jaxeit/methods.py", "jnp.linalg.svd"),
    }


def test_no_path_of_a_machine_in_the_project():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    for name in filter(lambda n: n.endswith((".py", ".toml", ".md", "Makefile")), tracked.split()):
        text = (ROOT / name).read_text()
        assert "/ro" + "ot/" not in text, name
        assert "/wo" + "rk/" not in text, name


def test_names_of_calib_are_there():
    for name in calib.__all__:
        if name != "write_report":  # needs matplotlib
            assert getattr(calib, name) is not None
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = calib.nothing_like_it


def test_names_for_type_checkers_are_those_at_run_time():
    tree = ast.parse((ROOT / "calib" / "__init__.py").read_text())
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level]
    named = {alias.name for node in froms for alias in node.names}
    assert named == set(calib.__all__)


def test_public_functions_of_jaxeit_are_documented():
    for name in je.__all__:
        thing = getattr(je, name)
        if callable(thing):
            assert thing.__doc__, name


@pytest.mark.parametrize("order", [1, 2])
def test_models_hold_arrays_of_one_precision_only(skin, order):
    model = je.discretise(je.Scene(skin), je.Fidelity.draft(dtype="float32", order=order))
    assert jnp.float64 not in {leaf.dtype for leaf in jax.tree.leaves(model)}


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from calib.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'jax', 'numpy', 'scipy', 'h5py', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=os.environ | {"COLUMNS": "80"}
    )
    assert done.returncode == 0, done.stderr
    assert "calibrate" in done.stdout


@pytest.mark.slow
def test_float32_runs_without_x64():
    """Nothing in the library asks for 64 bits behind the user's back; warnings are errors."""
    code = (
        "import jax, numpy as np, jaxeit as je\n"
        "skin = je.load_skin('testbed')\n"
        "model = je.discretise(je.Scene(skin), je.Fidelity.draft(dtype='float32', solver=je.Dense()))\n"
        "recon = je.prepare(model, basis=je.Pixels(20))\n"
        "image = recon(je.forward(model, 1.1 * model.background) - je.forward(model))\n"
        "fmap = je.fuse(image, je.pad_masks(skin, recon), jax.numpy.ones(4))\n"
        "assert fmap.force.dtype == np.float32\n"
        "assert abs(float(fmap.force.sum()) - 4) < 1e-5\n"
    )
    quiet = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False, env=quiet, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
