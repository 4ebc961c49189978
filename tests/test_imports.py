"""Imports compute nothing: a user may still choose JAX's precision and platform, and fork."""

import subprocess
import sys

WALK = """
import importlib, pkgutil
import calib, jaxeit
from jax._src import xla_bridge  # no public name tells without starting the backend

for package in (jaxeit, calib):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if module.name.endswith(".__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            assert (error.name or "").partition(".")[0] not in ("jaxeit", "calib"), error
        if xla_bridge.backends_are_initialized():
            raise SystemExit(f"{module.name} starts JAX when it is imported")
"""


def test_no_module_starts_jax_when_it_is_imported(root):
    done = subprocess.run(
        [sys.executable, "-c", WALK], cwd=root, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr[-1000:]


def test_images_do_without_the_solvers(root):
    """Optimistix takes a tenth of a second to import, which the first image need not wait for."""
    names = "je.load_skin, je.discretise, je.forward, je.prepare, je.LevelCentroid, je.pad_masks, je.fuse, je.Imaging"
    code = f"import sys; import jaxeit as je; {names}; raise SystemExit('optimistix' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=root, timeout=120, check=False).returncode == 0
