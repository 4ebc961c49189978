"""Start-up times of fresh processes: imports, help, the README's first program, and the command of `make demo`.

Times are from the start of a process to its end.  The program runs without a cache, with an empty one, with the cache
of JAX that this run filled, and with that of `je.cache_programs` beside it; the command with both, empty and full.
`phases` says what JAX spends of the program's time on tracing, on lowering, and on compiling or on reading the cache.
"""

import json
import re
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from functools import partial

import numpy as np

from .clock import fresh, in_turns, spread
from .harness import ROOT, Question, Run
from .rows import Row

COMMANDS = {
    "python": "pass",
    "import numpy": "import numpy",
    "import jax": "import jax",
    "import jaxeit": "import jaxeit",
    "first use of jaxeit": "import jaxeit; jaxeit.forward",
    "import calib": "import calib",
    "calib.open_session": "import calib; calib.open_session",
    "jaxeit --help": "import sys; sys.argv = ['jaxeit', '--help']; from calib.cli import main; main()",
}


EVENTS = {
    "tracing": "/jax/core/compile/jaxpr_trace_duration",
    "lowering": "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "compiling, or reading the cache": "/jax/core/compile/backend_compile_duration",
}
LISTENING = """
import atexit, collections, json, time
from jax import monitoring
spent = collections.Counter()
monitoring.register_event_duration_secs_listener(lambda name, seconds, **_: spent.update({name: seconds}))
atexit.register(lambda: print(json.dumps(spent)))
"""
KEEPING = "import jaxeit\njaxeit.cache_programs({folder!r})\n"


def measure(run: Run) -> Iterator[Row]:
    """Commands in turn, whose first round fills the system's file caches; then the program."""
    calls = {name: partial(fresh, code) for name, code in COMMANDS.items()}
    times = in_turns(calls, 2 if run.smoke else 10)
    yield {"rows": [{"start": name, **spread(taken[1:])} for name, taken in times.items()]}
    if not run.smoke:
        yield {"rows": programs(3)}
        yield {"rows": demos(3)}
        yield {"phases": phases(3)}


def program() -> str:
    """The README's first program."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"```python\n(.*?)```", readme, re.DOTALL)
    if found is None:
        raise SystemExit("README.md has no program to run")
    return found[1]


def programs(repeats: int) -> list[Row]:
    """The first program without a cache, with JAX's own, empty and full, and with both, full."""
    code, times = program(), defaultdict(list)
    for _ in range(repeats):
        times["no cache"].append(fresh(code)[0])
        with tempfile.TemporaryDirectory() as folder:
            for name in ("empty cache of JAX", "full cache of JAX"):
                times[name].append(fresh(code, cache=folder)[0])
            fresh(KEEPING.format(folder=folder) + code, cache=folder)
            times["both caches full"].append(fresh(KEEPING.format(folder=folder) + code, cache=folder)[0])
    return [{"start": f"the README's program, {name}", **spread(taken)} for name, taken in times.items()]


def demos(repeats: int) -> list[Row]:
    """The command of `make demo`, once all is installed."""
    recipe = re.search(r"^demo:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    if recipe is None:
        raise SystemExit("the Makefile has no demo")
    times = defaultdict(list)
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            words = recipe[1].replace("\\\n", " ").replace("$(OUT)", folder).split()[1:]
            code = "import os, sys; os.environ['XDG_CACHE_HOME'] = "
            code += f"{folder!r}; sys.argv = ['jaxeit', *{words}]; from calib.cli import main; main()"
            for name in ("empty caches", "full caches"):
                times[name].append(fresh(code)[0])
    return [{"start": f"the command of `make demo`, {name}", **spread(taken)} for name, taken in times.items()]


def phases(repeats: int) -> list[Row]:
    """What the first program spends in JAX without a cache, with JAX's own and with both, full, s."""
    found: Row = {name: {"phase": name} for name in EVENTS}
    with tempfile.TemporaryDirectory() as folder:
        keeping = KEEPING.format(folder=folder)
        fresh(program(), cache=folder)
        fresh(keeping + program(), cache=folder)
        for key, begin, cache in (("no_cache_s", "", ""), ("full_cache_s", "", folder), ("both_s", keeping, folder)):
            code = LISTENING + begin + program()
            runs = [json.loads(fresh(code, cache=cache)[1].splitlines()[-1]) for _ in range(repeats)]
            for name, event in EVENTS.items():
                found[name][key] = float(np.median([run[event] for run in runs]))
    return list(found.values())


main = Question("start", __doc__, {"rows": measure})

if __name__ == "__main__":
    main()
