"""Start-up times of fresh processes: imports, help, and the README's first program.

Times are from the start of a process to its end.  The program runs without a cache of compiled programs, with an empty
cache, and with the cache that this run filled.
"""

import re
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from functools import partial

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


def measure(run: Run) -> Iterator[Row]:
    """Commands in turn, whose first round fills the system's file caches; then the program."""
    calls = {name: partial(fresh, code) for name, code in COMMANDS.items()}
    times = in_turns(calls, 2 if run.smoke else 10)
    yield {"rows": [{"start": name, **spread(taken[1:])} for name, taken in times.items()]}
    if not run.smoke:
        yield {"rows": programs(3)}


def program() -> str:
    """The README's first program."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"```python\n(.*?)```", readme, re.DOTALL)
    if found is None:
        raise SystemExit("README.md has no program to run")
    return found[1]


def programs(repeats: int) -> list[Row]:
    """The first program without a cache, with an empty one, and with a full one."""
    code, times = program(), defaultdict(list)
    for _ in range(repeats):
        times["no cache"].append(fresh(code))
        with tempfile.TemporaryDirectory() as folder:
            for name in ("empty cache", "full cache"):
                times[name].append(fresh(code, cache=folder))
    return [{"start": f"the README's program, {name}", **spread(taken)} for name, taken in times.items()]


main = Question("start", __doc__, {"rows": measure})

if __name__ == "__main__":
    main()
