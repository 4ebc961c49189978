"""The first second: imports, help, and the README's first program, each in a fresh process.

python -m benchmarks.bench_start [--smoke]

Seconds are from the start of a process to its end.  The program runs without a cache of compiled programs, with an
empty one, and with what that run left there.  What an import takes is read off `python -X importtime`: the time of
each package's own modules.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from . import _common as c

COMMANDS = {
    "python": "pass",
    "import numpy": "import numpy",
    "import jax": "import jax",
    "import jaxeit": "import jaxeit",
    "import calib": "import calib",
    "calib.open_session": "import calib; calib.open_session",
    "jaxeit --help": "import sys; sys.argv = ['jaxeit', '--help']; from calib.cli import main; main()",
}
IMPORTS = ("jaxeit", "calib.calibration")
CACHE = {  # what the command line sets, calib/runtime.py
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
_SETTINGS = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_X64", *CACHE)

Row = dict[str, Any]


def environment(cache: Path | None = None) -> dict[str, str]:
    bare = {name: value for name, value in os.environ.items() if name not in _SETTINGS}
    return bare if cache is None else bare | CACHE | {"JAX_COMPILATION_CACHE_DIR": str(cache)}


def process(code: str, *options: str, cache: Path | None = None) -> tuple[float, str]:
    """Seconds of a fresh Python that runs the code, and what it wrote to standard error."""
    command = [sys.executable, *options, "-c", code]
    spent, done = c.seconds(
        lambda: subprocess.run(command, cwd=c.ROOT, env=environment(cache), capture_output=True, text=True, check=True)
    )
    return spent, done.stderr


def starts(repeats: int) -> list[Row]:
    """All in turn, round after round."""
    times: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for _ in range(repeats + 1):
        for name, code in COMMANDS.items():
            times[name].append(process(code)[0])
    return [{"start": name, **c.spread(taken[1:])} for name, taken in times.items()]  # the first fills file caches


def program() -> str:
    """The README's first program."""
    readme = (c.ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"```python\n(.*?)```", readme, re.DOTALL)
    if found is None:
        raise SystemExit("README.md has no program to run")
    return found[1]


def programs(repeats: int) -> list[Row]:
    """The first program without a cache, with an empty one, and with a full one."""
    code, times = program(), defaultdict(list)
    for _ in range(repeats):
        times["no cache"].append(process(code)[0])
        with tempfile.TemporaryDirectory() as folder:
            for name in ("empty cache", "full cache"):
                times[name].append(process(code, cache=Path(folder))[0])
    return [{"start": f"the README's program, {name}", **c.spread(taken)} for name, taken in times.items()]


def packages(module: str) -> list[Row]:
    """What the import of a module takes, by package, most first."""
    lines = re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)", process(f"import {module}", "-X", "importtime")[1])
    own: dict[str, float] = defaultdict(float)
    for microseconds, name in lines:
        own[name.split(".")[0]] += int(microseconds) / 1e3
    most = sorted(own.items(), key=lambda item: -item[1])[:12]
    return [{"package": name, "ms": round(ms, 1)} for name, ms in most]


def table(rows: list[Row]) -> str:
    lines = ["| fresh process | s, median (min to max) |", "|---|---|"]
    lines += [
        f"| {r['start']} | {r['median_ms'] / 1e3:.3f} ({r['min_ms'] / 1e3:.3f} to {r['max_ms'] / 1e3:.3f}) |"
        for r in rows
    ]
    return "\n".join(lines)


def import_table(imports: dict[str, list[Row]]) -> str:
    lines = []
    for module, rows in imports.items():
        total = np.sum([r["ms"] for r in rows])
        shares = ", ".join(f"{r['package']} {r['ms']:.0f}" for r in rows if r["ms"] > 0.02 * total)
        lines.append(f"import {module}, ms by package: {shares}")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="imports once each; nothing written")
    args = parser.parse_args(argv)
    data: dict[str, Any] = {"circumstances": c.circumstances()}
    data["rows"] = starts(1) if args.smoke else starts(9) + programs(3)
    data["imports"] = {module: packages(module) for module in IMPORTS}
    print(table(data["rows"]), import_table(data["imports"]), sep="\n\n", flush=True)
    if not args.smoke:
        c.write("start", c.closed(data))
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
