"""Forward solves with 64 contacts in one call, every tool in one run; BLAS has one thread, others all cores."""

import os

from .comparison import Comparison, factorisation
from .harness import Question, with_one_blas_thread
from .peers import superlu
from .problems import Problem
from .tools import CONTACTS


def work(problem: Problem, image: str) -> dict[str, float]:
    """A factorisation for each contact."""
    return {name: CONTACTS * value for name, value in factorisation(problem).items()}


BATCHES = Comparison("batch", superlu.NAME, "voltages", work, repeats=5, largest=120)
main = Question("batch", __doc__, {"rows": BATCHES})

if __name__ == "__main__":
    # A device of JAX for each core, of which `jaxeit.bind_many` uses all, and the other entries the first.
    with_one_blas_thread(JAX_NUM_CPU_DEVICES=str(os.cpu_count()))
    main()
