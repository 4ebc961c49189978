"""What accuracy costs in time on the shipped skins: `jaxeit bench` for both, kept and drawn.

python -m benchmarks.ladder [--smoke | --draw-only]
"""

import argparse
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np

import jaxeit as je
from calib.figures import write_figure
from calib.ladder_figure import ladder_figure
from jaxeit.solvers import NestedDissection

from . import _common as c

PICTURE = c.ROOT / "docs" / "ladder.png"
SKINS = ("testbed", "chest")


def measure(name: str, choices: tuple[je.Choice, ...] | None, machine: dict[str, float]) -> dict[str, Any]:
    """The ladder of a shipped skin as numbers, with the least time of each of our float64 factorisations."""
    scene = je.Scene(je.load_skin(name))
    found = je.ladder(scene, choices)
    print(found.table(), flush=True)
    numbers = found.summary()
    for rung, row in zip(found.rungs, numbers["rungs"], strict=True):
        row |= least(scene, rung.choice.fidelity, machine)
    return numbers


def least(scene: je.Scene, fidelity: je.Fidelity, machine: dict[str, float]) -> dict[str, float]:
    """The time that the factorisation takes at the machine's limits; nothing for other solvers or precisions."""
    if fidelity.solver is not None or fidelity.dtype != np.float64:
        return {}
    model = je.discretise(scene, fidelity)
    if not isinstance(model.solver, NestedDissection):
        return {}
    work = c.factorisation(SimpleNamespace(model=lambda: model))  # type: ignore[arg-type]
    return {"least_ms": 1e3 * max(work["flops"] / machine["flop_per_s"], work["bytes"] / machine["byte_per_s"])}


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="one skin, two coarse rungs, nothing written")
    parser.add_argument("--draw-only", action="store_true", help="draw the stored results again")
    args = parser.parse_args(argv)
    c.set_up()
    if args.draw_only:
        write_figure(ladder_figure(c.stored("ladder")["ladders"]), PICTURE)
        return {}
    data: dict[str, Any] = {"circumstances": c.circumstances(), "limits": c.limits()}
    skins, choices = (SKINS[:1], je.few_choices()) if args.smoke else (SKINS, None)
    data["ladders"] = [measure(name, choices, data["limits"]) for name in skins]
    if not args.smoke:
        c.write("ladder", c.closed(data))
        write_figure(ladder_figure(data["ladders"]), PICTURE)
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
