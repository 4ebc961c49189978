"""Simulate a session and write it: python -m tests.oracles.bench OUT.h5 [--crosstalk 0.05 ...]."""

import argparse
from dataclasses import fields
from pathlib import Path

from . import Bench, Faults, simulate, write


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.oracles.bench", description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--levels", type=float, nargs="+", default=Bench.levels, help="forces at each place, N")
    for kind in (Bench, Faults):
        for entry in fields(kind):
            if isinstance(entry.default, int | float | str):
                parser.add_argument(
                    f"--{entry.name.replace('_', '-')}", type=type(entry.default), default=entry.default
                )
    given = vars(parser.parse_args(argv))
    out, given["levels"] = given.pop("out"), tuple(given["levels"])
    faults = Faults(**{entry.name: given.pop(entry.name) for entry in fields(Faults)})
    write(out, simulate(Bench(faults, **given)))


if __name__ == "__main__":
    main()
