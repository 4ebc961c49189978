"""What accuracy costs in time on the shipped skins: `jaxeit bench` for both, kept and drawn."""

from collections.abc import Iterator, Mapping

import numpy as np

import jaxeit as je
from calib.report.figures.accuracy import ladder_figure
from jaxeit.linalg import NestedDissection

from .clock import limits
from .comparison import factorisation_of, least_ms
from .harness import Question, Run
from .rows import Row

SKINS = ("testbed", "chest")


def measure(run: Run) -> Iterator[Row]:
    """The ladder of each shipped skin, with the least time of each of our float64 factorisations."""
    machine = limits()
    yield {"limits": machine, "ladders": []}
    skins, choices = (SKINS[:1], je.accuracy.few_choices()) if run.smoke else (SKINS, None)
    for scene in (je.Scene(je.load_skin(name)) for name in skins):
        found = je.ladder(scene, choices)
        print(found.table(), flush=True)
        numbers = found.summary()
        for rung, row in zip(found.rungs, numbers["rungs"], strict=True):
            row |= least(scene, rung.choice.fidelity, machine)
        yield {"ladders": [numbers]}


def least(scene: je.Scene, fidelity: je.Fidelity, machine: Mapping[str, float]) -> dict[str, float]:
    """The time that the factorisation takes at the machine's limits; nothing for other solvers or precisions."""
    if fidelity.solver is not None or fidelity.dtype != np.float64:
        return {}
    model = je.discretise(scene, fidelity)
    return (
        {"least_ms": least_ms(factorisation_of(model), machine)} if isinstance(model.solver, NestedDissection) else {}
    )


main = Question(
    "ladder", __doc__, {"ladders": measure}, picture=lambda data: ladder_figure(data["ladders"]), file="ladder.png"
)

if __name__ == "__main__":
    main()
