"""One command for every question: its options, its parts, where the results go, its tables and its picture."""

import argparse
import json
import os
import platform
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
from matplotlib.figure import Figure

import jaxeit as je
from calib.report.figures.parts import write_figure
from calib.session import replacing

from . import tables
from .peers import eidors
from .rows import Row

ROOT = Path(__file__).parents[1]
MAIN = "2-core-x86"  # the machine of all sections that it has measured
RESULTS = Path(__file__).parent / "results"


def measured() -> Row:
    """The sections of all machines."""
    files = sorted(RESULTS.glob("*.json"), key=lambda file: file.stem == MAIN)
    return {name: data for file in files for name, data in json.loads(file.read_text(encoding="utf-8")).items()}


def set_up() -> None:
    """64-bit numbers, and memory that is used again, whatever the tool (in `peers.eidors` as well).

    No cache of compiled programs, as `calib.runtime.set_up` has it: what the first call takes is measured.
    """
    jax.config.update("jax_enable_x64", True)
    je.reuse_memory()


def with_one_blas_thread(**more: str) -> None:
    """Start this command anew where BLAS has more threads: it reads their number once, when NumPy is imported.

    ``more``: other variables of the environment that are read at imports.
    """
    wanted = {"OPENBLAS_NUM_THREADS": "1", **more}
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        os.environ |= wanted | {"OMP_NUM_THREADS": "1"}
        os.execv(sys.executable, [sys.executable, "-m", f"benchmarks.{Path(sys.argv[0]).stem}", *sys.argv[1:]])


@dataclass(eq=False)
class Run:
    """A question while it is measured: the options given, and its section of the results so far."""

    args: argparse.Namespace
    data: Row = field(default_factory=dict)

    @property
    def smoke(self) -> bool:
        """Whether the smallest sizes are wanted, with nothing written."""
        return self.args.smoke

    def sizes(self, full: Sequence[Any], smoke: Sequence[Any]) -> Sequence[Any]:
        """Those of a smoke run or the full ones."""
        return smoke if self.smoke else full


Part = Callable[[Run], Iterable[Row]]


@dataclass(frozen=True, eq=False)
class Question:
    """A benchmark as a command.

    | meaning                                                                                          |
    |--------------------------------------------------------------------------------------------------|
    | section of the results; about: the module's docstring                                            |
    | parts: each yields keys of the section; a list is continued by the next list under its key       |
    | options: of the command line beside those that all have, as `argparse` takes them                |
    | picture: draws a section; file: where in docs/ the picture goes                                  |
    | prepare: what the process sets up first                                                          |
    """

    section: str
    about: str | None
    parts: Mapping[str, Part]
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    picture: Callable[[Row], Figure] | None = None
    file: str = ""
    prepare: Callable[[], None] = set_up

    def __call__(self, argv: list[str] | None = None) -> Row:
        """Measure, print, write and draw, as the command line asks."""
        args = self._parser().parse_args(argv)
        self.prepare()
        if args.draw_only:
            self._draw(stored(args.section))
            return {}
        run = Run(args, dict(stored(args.section)) if args.only else {})
        run.data |= {"circumstances": circumstances()}
        for name, part in self.parts.items():
            if args.only in (None, name):
                self._measure(run, part)
        print(tables.report(args.section, run.data), flush=True)
        if not args.smoke:
            self._draw(run.data)
        return run.data

    def _measure(self, run: Run, part: Part) -> None:
        fresh: set[str] = set()
        for piece in part(run):
            for key, value in piece.items():
                run.data[key] = run.data[key] + value if key in fresh and isinstance(value, list) else value
            fresh |= piece.keys()
            if not run.smoke:  # at once: what is done is not lost if the rest is stopped
                write(run.args.section, closed(run.data))

    def _draw(self, data: Row) -> None:
        if self.picture is not None:
            write_figure(self.picture(data), ROOT / "docs" / self.file)

    def _parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            description=self.about,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            prog=f"python -m benchmarks.{Path(sys.argv[0]).stem}",
        )
        parser.add_argument("--smoke", action="store_true", help="the smallest sizes, few repeats, nothing written")
        parser.add_argument("--section", default=self.section, help="name of this run among the results")
        parser.add_argument("--only", choices=self.parts, help="measure this part; the others stay as stored")
        parser.add_argument("--draw-only", action="store_true", help="draw the stored results again")
        for name, how in self.options.items():
            parser.add_argument(name, **how)
        return parser


# --- results


def machine() -> str:
    """A neutral name: cores and kind of processor, and the GPU that JAX uses."""
    kind = {"x86_64": "x86", "AMD64": "x86", "aarch64": "arm", "arm64": "arm"}
    device = jax.devices()[0]
    gpu = "" if device.platform == "cpu" else "-" + re.sub(r"\W+", "-", device.device_kind.lower())
    return f"{os.cpu_count()}-core-{kind.get(platform.machine(), platform.machine())}{gpu}"


def circumstances() -> Row:
    """Machine, threads, load and versions, by which a reader can judge the times."""
    names = ("jax", "jaxlib", "numpy", "scipy", "pyeit", "scikit-sparse")
    threads = ("XLA_FLAGS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "device": jax.devices()[0].platform,
        "threads": {name: os.environ.get(name, "not set") for name in threads},
        "load_before": [round(load, 2) for load in os.getloadavg()],
        "versions": {name: _version(name) for name in names} | eidors.versions(),
    }


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def closed(data: Row) -> Row:
    """The results so far, with the machine's load now."""
    return data | {"circumstances": data["circumstances"] | {"load_after": [round(x, 2) for x in os.getloadavg()]}}


def write(section: str, data: Row, folder: Path | None = None) -> Path:
    """Replace one section of this machine's results."""
    path = (folder or RESULTS) / f"{machine()}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as new:
        new.write_text(json.dumps(_read(path) | {section: data}, indent=1) + "\n", encoding="utf-8")
    return path


def stored(section: str) -> Row:
    """The last results of this machine in a section.

    Raises:
        SystemExit: if it has not measured this.
    """
    path = RESULTS / f"{machine()}.json"
    results = _read(path)
    if section not in results:
        raise SystemExit(f"{path} has no {section!r}; measure first (leave out --draw-only and --only)")
    return results[section]


def _read(path: Path) -> Row:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
