"""The laws of the architecture, held from the source itself."""

import ast
import os
import pkgutil
import re
import subprocess
import sys
from importlib import import_module
from inspect import isclass, isfunction, signature, unwrap
from itertools import chain
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import pytest

import calib
import jaxeit as je
from benchmarks.house import MAX_NAMES

ROOT = Path(__file__).parents[1]
ORDER = [
    "messages", "budget", "files", "array_files", "notebook", "program_cache", "_compile", "batches", "toml",
    "registry", "geometry", "meshing", "linalg", "skin", "effects", "least_squares", "model",
    "imaging", "metrics", "fusion", "contacts", "tracking", "scan", "accuracy", "plot", "__main__",
]  # fmt: skip
BENCH = [
    "session", "presses", "fitting", "runtime", "record", "check", "calibration", "export", "bench",
    "simulators", "live", "report", "batch", "learning", "tanks", "cli",
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


def _without_docstrings(tree):
    """The tree without its texts that stand alone."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            node.value = ast.Constant(...)
    return tree


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


@pytest.mark.parametrize("package", ["jaxeit", "calib"])
def test_no_room_holds_more_than_twelve_modules(package):
    folders = [ROOT / package, *(path for path in (ROOT / package).rglob("*") if path.is_dir())]
    assert [(str(each), count) for each in folders if (count := len(list(each.glob("*.py")))) > 12] == []


@pytest.mark.parametrize(("package", "order"), [("jaxeit", ORDER), ("calib", BENCH)])
def test_imports_are_at_most_eight_rooms_deep(package, order):
    depth = dict.fromkeys(order, 1)
    for room in order:  # each room imports earlier ones only
        for path in [*(ROOT / package / room).rglob("*.py"), *(ROOT / package).glob(f"{room}.py")]:
            below = [depth[used] for used in _imports(path, package) if used and used != room]
            depth[room] = max(depth[room], 1 + max(below, default=0))
    assert max(depth.values()) <= 8, depth


def test_files_are_read_and_recorded_without_jax():
    """The recorder and the readers of files hold the limits of `jaxeit.budget`, and start without JAX."""
    code = "import sys, calib.session, calib.record.recorder; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_toml_enters_by_one_door():
    """Parsed without limits, a short text needs time and memory without end."""
    users = {str(p.relative_to(ROOT)) for n in ("jaxeit", "calib") for p in (ROOT / n).rglob("*.py")
             if "tomllib" in p.read_text()}  # fmt: skip
    assert users == {"jaxeit/toml.py"}


def test_jaxeit_knows_nothing_of_calib_or_files():
    for path in (ROOT / "jaxeit").rglob("*.py"):
        assert not list(_imports(path, "calib")), path
        assert not list(_imports(path, "h5py")), path
        assert "import h5py" not in path.read_text(), path


def test_calib_uses_what_the_rooms_of_jaxeit_offer():
    """Names of `jaxeit` in calib are those that a package or a module beside the rooms lists or defines as public."""
    hidden = []
    for path in (ROOT / "calib").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").startswith("jaxeit."):
                module = import_module(node.module)
                offered = getattr(module, "__all__", () if node.module.count(".") > 1 else dir(module))
                hidden += [(str(path), node.module, each.name) for each in node.names if each.name not in offered]
    assert hidden == []


def test_only_the_session_package_touches_hdf5():
    users = {_room(p, "calib") for p in (ROOT / "calib").rglob("*.py") if "import h5py" in p.read_text()}
    assert users == {"session"}


def test_only_the_command_line_touches_the_configuration_of_jax():
    """In what Python executes: the programs in docstrings are those of users, who may."""
    for package in ("jaxeit", "calib"):
        for path in (ROOT / package).rglob("*.py"):
            if _room(path, package) != "runtime":
                code = ast.unparse(_without_docstrings(ast.parse(path.read_text())))
                assert not re.search(r"^ *jax\.config\.", code, re.MULTILINE), path


def test_factors_and_solves_are_those_that_are_safe_under_vmap():
    """See `jaxeit.linalg.lapack`: also what is prepared once may be mapped over."""
    theirs = r"from jax\.scipy\.linalg|\b(?:jnp|jsp|lax|jax\.scipy)\.linalg\.(?!norm)\w+(?=[(,)])"
    found = {
        (str(path.relative_to(ROOT)), name)
        for package in ("jaxeit", "calib")
        for path in (ROOT / package).rglob("*.py")
        for name in re.findall(theirs, path.read_text())
    }
    own = {"jaxeit/linalg/lapack.py", "jaxeit/linalg/multifrontal/nested_dissection.py"}
    assert {(path, name) for path, name in found if path not in own} == set()


def _names_in_messages():
    """Names such as je.imaging.LCurve in texts that are no docstrings, and the files that have them."""
    for package in ("jaxeit", "calib"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(_without_docstrings(ast.parse(path.read_text()))):
                text = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""
                if " " in text.strip():  # the others are names of files, groups and modules
                    for name in re.findall(r"\b(?:je|jaxeit|calib)(?:\.[A-Za-z_]\w*)+", text):
                        yield name, path


def test_names_that_messages_advise_exist():
    names = set(_names_in_messages())
    assert len(names) > 20
    for name, path in names:
        package, *parts = name.split(".")
        try:
            pkgutil.resolve_name(".".join([{"je": "jaxeit"}.get(package, package), *parts]))
        except (AttributeError, ImportError):
            pytest.fail(f"{path}: there is no {name}")


def test_no_path_of_a_machine_in_the_project():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    for name in filter(lambda n: n.endswith((".py", ".toml", ".md", "Makefile")), tracked.split()):
        text = (ROOT / name).read_text()
        assert "/ro" + "ot/" not in text, name
        assert "/wo" + "rk/" not in text, name


def _public_names():
    """Public name -> the objects it stands for, over both packages and their rooms."""
    found = {}
    for package in (je, calib):
        rooms = [getattr(package, name) for name in package.__all__ if isinstance(getattr(package, name), ModuleType)]
        for room in [package, *rooms]:
            for name in getattr(room, "__all__", ()):
                thing = getattr(room, name)
                found.setdefault(name, {})[id(thing)] = thing
    return {name: tuple(things.values()) for name, things in found.items()}


def test_no_module_hides_a_public_function():
    functions = {name for name, things in _public_names().items() if any(isfunction(thing) for thing in things)}
    modules = {path.stem for package in ("jaxeit", "calib") for path in (ROOT / package).rglob("*.py")}
    assert modules & functions == set()


def test_no_two_public_things_share_a_name():
    assert {name: things for name, things in _public_names().items() if len(things) > 1} == {}


def test_no_two_classes_share_a_name():
    """Private ones too, except those inside a function or a class, which only their own place names."""
    found = {}
    for package in ("jaxeit", "calib"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef):
                    found.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert len(found) > 500
    assert {name: paths for name, paths in found.items() if len(paths) > 1} == {}


def test_bases_that_users_derive_from_are_reachable():
    """Every public class shows its abstract bases in the room that it is in."""
    for name, things in _public_names().items():
        for thing in things:
            for base in thing.__mro__[1:] if isclass(thing) else ():
                if base.__module__.startswith(("jaxeit.", "calib.")) and base.__name__.startswith("Abstract"):
                    assert base.__name__ in _public_names(), f"{name}: {base}"


def _own_methods(kind):
    """Public methods and properties of a class that it or a base of this project defines."""
    for base in kind.__mro__:
        for name, thing in vars(base).items() if base.__module__.startswith(("jaxeit.", "calib.")) else ():
            if name == "__call__" or not name.startswith("_"):
                part = next((getattr(thing, at) for at in ("fget", "func", "__func__") if hasattr(thing, at)), thing)
                yield unwrap(part)


def _public_functions():
    """Each public function and method of this project, without what compiles it."""
    public = list(chain(*_public_names().values()))
    things = chain(*(_own_methods(thing) if isclass(thing) else (unwrap(thing),) for thing in public))
    return {thing for thing in things if isfunction(thing) and thing.__module__.startswith(("jaxeit.", "calib."))}


def test_public_functions_are_annotated():
    functions = _public_functions()
    assert {unwrap(je.fuse), unwrap(je.contacts.ContactFinder.__call__)} <= functions
    incomplete = {}
    for function in functions:
        names = {*signature(function).parameters, "return"} - {"self", "cls"}
        if missing := names - set(function.__annotations__):
            room = ".".join(function.__module__.split(".")[:2])
            incomplete.setdefault(room, []).append(f"{function.__qualname__}: {', '.join(sorted(missing))}")
    assert incomplete == {}


@pytest.mark.parametrize(("package", "most"), list(zip((je, calib), MAX_NAMES, strict=True)), ids=["je", "calib"])
def test_the_names_at_the_top_are_few(package, most):
    names = [name for name in package.__all__ if not isinstance(getattr(package, name), ModuleType)]
    assert most / 2 < len(names) <= most


def test_names_of_calib_are_there():
    for name in calib.__all__:
        if name != "write_report":  # needs matplotlib
            assert getattr(calib, name) is not None
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = calib.nothing_like_it


LAZY = [path.parent for package in ("jaxeit", "calib") for path in sorted((ROOT / package).rglob("__init__.pyi"))]


@pytest.mark.parametrize("room", LAZY, ids=lambda folder: folder.name)
def test_names_that_are_imported_on_first_use_exist(room):
    module = import_module(".".join(room.relative_to(ROOT).parts))
    assert len(module.__all__) > 5
    assert all(getattr(module, name) is not None for name in module.__all__)


def test_the_recorder_and_the_readers_of_files_import_no_jax():
    code = "import calib.record.recorder, calib.session, sys; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.parametrize("order", [1, 2])
def test_models_hold_arrays_of_one_precision_only(skin, order):
    model = je.discretise(je.Scene(skin), je.Fidelity.draft(dtype="float32", order=order))
    assert jnp.float64 not in {leaf.dtype for leaf in jax.tree.leaves(model)}


def test_libraries_of_other_projects_are_imported_when_they_are_asked_for():
    code = (
        "import sys, calib.export, calib.live.bridges, calib.cli\n"
        "theirs = {'foxglove', 'lerobot', 'mujoco', 'pyarrow', 'rclpy', 'rerun', 'rosbags', 'websockets'}\n"
        "sys.exit(f'imported {found}' if (found := theirs & set(sys.modules)) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_what_only_an_error_needs_is_imported_by_the_error():
    code = (
        "import sys, jaxeit\n"
        "late = {'jaxeit.messages.missing_names', 'jaxeit.messages.spelling', 'difflib'}\n"
        "early = late & set(sys.modules)\n"
        "try: jaxeit.Nosser\n"
        "except AttributeError: pass\n"
        "sys.exit(f'imported {early} of {late & set(sys.modules)}' if early or late - set(sys.modules) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr


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
        "model = je.discretise(je.Scene(skin), je.Fidelity.draft(dtype='float32', solver=je.linalg.Dense()))\n"
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


@pytest.mark.parametrize(
    ("package", "name", "said"),
    [
        (je, "LCurve", "jaxeit has no LCurve; it is jaxeit.imaging.LCurve"),
        (je, "ForceMap", "jaxeit has no ForceMap; it is jaxeit.fusion.ForceMap"),  # a room that is one module
        (je, "Nosser", "jaxeit has no Nosser; did you mean 'Noser'?"),
        (je, "eidors_obj", "jaxeit has no eidors_obj"),
        (calib, "Evaluation", "calib has no Evaluation; it is calib.calibration.Evaluation"),
        (calib, "calibrat", "calib has no calibrat; did you mean 'calibrate'?"),
        (calib, "mk_stim_patterns", "calib has no mk_stim_patterns"),  # a word of what images, which calib does not
    ],
)
def test_a_name_of_a_room_is_told_where_it_is_missed(package, name, said):
    with pytest.raises(AttributeError) as caught:
        getattr(package, name)
    assert str(caught.value) == said
