"""EIDORS (GPL: a peer to measure against, never a dependency) in GNU Octave, as its users call it.

`fwd_solve`, `calc_jacobian` and the matrix of `inv_solve_diff_GN_one_step` on the same mesh, electrode nodes and pairs.
Octave is a process of its own and reads the clock itself: its start and the files that carry conductivity and results
do not count.
"""

import os
import shutil
import subprocess
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

NAME = "EIDORS"
SCRIPT = Path(__file__).with_suffix(".m")
REUSE_MEMORY = dict.fromkeys(("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"), str(2**31 - 1))
REUSE_MEMORY["MALLOC_ARENA_MAX"] = "1"


def missing() -> str | None:
    home = Path(os.environ.get("EIDORS", ""))
    if not shutil.which("octave-cli"):
        return "octave-cli is not on PATH (install GNU Octave)"
    if not (home / "startup.m").is_file():
        return "the environment variable EIDORS does not name the folder that holds EIDORS's startup.m"
    if not (shutil.which("mkoctfile") or any(home.glob("arch/octave/*/eidors_var_id.mex"))):
        return "mkoctfile is not on PATH (install Octave's development files): EIDORS compiles a part of itself once"
    return None


def run_program(folder: Path, program: str) -> subprocess.CompletedProcess[str]:
    """Run a program of EIDORS's users in a folder, without windows."""
    begin = "run([getenv('EIDORS') '/startup.m']); set(0, 'defaultfigurevisible', 'off');\n"
    (folder / "program.m").write_text(begin + program, encoding="utf-8")
    command = ["octave-cli", "--norc", "--quiet", "program.m"]
    env = os.environ | {"EIDORS": str(Path(os.environ["EIDORS"]).resolve())}
    return subprocess.run(command, cwd=folder, env=env, input="\n", capture_output=True, text=True, check=False)


class Eidors:
    """A tool that has Octave at work; `last_seconds` is what Octave measured around its last call.

    ``verb``: "forward", whose ``order`` 2 has six-node triangles (`fwd_solve_higher_order`); "jacobian"; "inverse", the
    matrix of `inv_solve_diff_GN_one_step` with `prior_noser`, (basis, readings), for a ``hyperparameter``; "pipeline",
    images of ``frames`` (readings, frames) by it, the model made anew in each call.  Onto elements, or onto ``pixels``
    (elements, basis): the quicker of EIDORS's `coarse2fine` and a product.
    """

    def __init__(self, problem, verb: str = "forward", order: int = 1, pixels=None, **extra: Any) -> None:
        folder = tempfile.TemporaryDirectory(prefix="eidors-")
        self.folder, self.last_seconds = Path(folder.name), float("nan")
        image = problem.mesh.triangles if pixels is None else pixels.T
        self.rows = (image if verb in ("inverse", "pipeline") else problem.pattern).shape[0]
        savemat(self.folder / "work.mat", _work(problem, pixels) | {"verb": verb, "order": order} | extra)
        self.process: Any = subprocess.Popen(
            ["octave-cli", "--norc", "--quiet", SCRIPT, self.folder],
            env=os.environ | REUSE_MEMORY | {"EIDORS": str(Path(os.environ["EIDORS"]).resolve())},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.close = weakref.finalize(self, _stop, self.process, folder)
        self._say("")  # EIDORS asks whether to compile anew where its source is newer: its own choice
        self._wait("started")
        self._wait("ready")

    def __call__(self, sigma: np.ndarray) -> np.ndarray:
        np.asarray(sigma, np.float64).tofile(self.folder / "sigma")
        self._say("go")
        self.last_seconds = float(self._wait("seconds"))
        return np.fromfile(self.folder / "result").reshape(-1, self.rows).T.squeeze()

    def _say(self, line: str) -> None:
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def _wait(self, word: str) -> str:
        """The rest of the first line that starts with ``word``."""
        said = []
        for line in self.process.stdout:
            if line.startswith(word):
                return line.removeprefix(word)
            said.append(line)
        raise RuntimeError(f"Octave stopped:\n{''.join(said[-20:])}")


def _work(problem, pixels) -> dict:
    """What Octave loads; it counts from one."""
    nodes = problem.mesh.nodes
    ground = int(np.setdiff1d(np.arange(len(nodes)), problem.electrode_nodes)[0])
    work = {
        "nodes": nodes,
        "elems": problem.mesh.triangles + 1.0,
        "electrodes": problem.electrode_nodes + 1.0,
        "ground": ground + 1.0,
        "pairs": problem.pairs + 1.0,
        "kept": problem.kept,
    }
    return work if pixels is None else work | {"coarse2fine": pixels}


def _stop(process: subprocess.Popen, folder: tempfile.TemporaryDirectory) -> None:
    process.communicate("stop\n")
    folder.cleanup()


def versions() -> dict[str, str]:
    """Of Octave and of EIDORS; empty where one of them is missing."""
    if missing():
        return {}
    ask = "addpath(getenv('EIDORS')); printf('%s %s', version(), eidors_obj('eidors_version'))"
    command = ["octave-cli", "--norc", "--quiet", "--eval", ask]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(zip(("octave", "eidors"), done.stdout.split(), strict=True))
