"""Read foreign binary files in a process of its own, with bounded memory and time.

The libraries of these formats allocate what a file claims, follow its links and may crash on a damaged one. A crash, an
enormous allocation or a loop in them ends the child process, and the import ends with one line.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxeit.budget import current_budget

from ..errors import SessionError, printable, problem
from ..outputs import writing

try:
    import resource
except ImportError:  # a system without limits for processes: the time alone is bounded
    resource = None  # type: ignore[assignment]

COMMAND = f"from {__name__} import main; main()"
BAD_FILE, NO_LIBRARY, TOO_LONG = 2, 3, 4
"""Exit statuses: the file cannot be used, a library is not installed, the time limit was exceeded (TOO_LONG)."""
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}
"""One thread each; the HDF5 library loads no plug-ins."""
DAMAGED = "the file is damaged, or of another format; take another copy"


def library(module: str, extra: str) -> ModuleType:
    """A library that is installed with an extra; raises ImportError with the command that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        name = module.split(".")[0]
        raise ImportError(f"this format needs {name}: pip install 'jaxeit[{extra}]'") from error


def in_child(reader: type, task: str, path: Path, *, names: Sequence[str] = (), folder: Path | None = None) -> Any:
    """The result of ``reader.task(path[, names][, folder])``, a class method, run in a child process.

    The result must be JSON. Arrays that the method returns as a list are written to ``folder`` as ``0.npy``, ``1.npy``.

    Raises:
        SessionError: for a file that cannot be used, or that needs more memory or time than a child process has.
        ImportError: a library is not installed.
    """
    request = {"module": reader.__module__, "reader": reader.__qualname__, "task": task, "path": str(path)}
    request |= {"names": list(names), "folder": None if folder is None else str(folder)}  # type: ignore[dict-item]
    status, said = _asked(json.dumps(request))
    if status == 0:
        return json.loads(said)
    if status == BAD_FILE:
        raise SessionError(said)
    if status == NO_LIBRARY:
        raise ImportError(said)
    if status == TOO_LONG:
        raise problem(path, "file", f"takes more than {current_budget().child_seconds} s to read", DAMAGED)
    what = f"ends the process that reads it ({printable(said) or f'status {status}'})"
    raise problem(path, "file", what, DAMAGED)


def _asked(request: str) -> tuple[int, str]:
    """Exit status and last line of a child process."""
    environment = os.environ | ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    options: dict[str, Any] = {"env": environment, "capture_output": True, "text": True}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", COMMAND],
            input=request,
            check=False,
            timeout=current_budget().child_seconds,
            **options,
        )
    except subprocess.TimeoutExpired:
        return TOO_LONG, ""
    lines = (done.stdout if done.returncode == 0 else done.stderr).splitlines()
    return done.returncode, lines[-1] if lines else ""


# --- in the child --------------------------------------------------------------------------------


def main() -> None:
    """Process the request on standard input: print its result as JSON, or the error on standard error."""
    _limit()
    status, said = answer(sys.stdin.read())
    print(said, file=sys.stderr if status else sys.stdout)
    sys.exit(status)


def answer(text: str) -> tuple[int, str]:
    """Exit status, and the result as JSON or the error in one line."""
    request = json.loads(text)
    path = Path(request["path"])
    try:
        return 0, json.dumps(_done(request, path))
    except SessionError as error:
        return BAD_FILE, str(error)
    except ImportError as error:
        return NO_LIBRARY, str(error)
    except MemoryError:
        what = f"needs more than {current_budget().child_bytes:,} bytes of memory"
        return BAD_FILE, str(problem(path, "file", what, "split the recording into shorter ones"))
    except Exception as error:  # whatever a library of a format raises
        what = f"cannot be read ({type(error).__name__}: {' '.join(str(error).split())})"
        return BAD_FILE, str(problem(path, "file", what, DAMAGED))


def _limit() -> None:
    if resource is not None:
        budget = current_budget()
        for kind, limit in ((resource.RLIMIT_AS, budget.child_bytes), (resource.RLIMIT_CPU, budget.child_seconds)):
            with contextlib.suppress(ValueError, OSError):  # a lower limit is in force already
                resource.setrlimit(kind, (limit, limit))


def _done(request: dict[str, Any], path: Path) -> Any:
    reader: Any = getattr(import_module(request["module"]), request["reader"])
    task = getattr(reader, request["task"])
    more = [request["names"]] if request["names"] else []
    if request["folder"] is None:
        return task(path, *more)
    folder = Path(request["folder"])
    if not more:
        return task(path, folder)
    for number, array in enumerate(task(path, *more)):
        with writing(folder / f"{number}.npy"):
            np.save(folder / f"{number}.npy", array, allow_pickle=False)
    return None
