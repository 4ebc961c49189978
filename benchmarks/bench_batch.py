"""Forward solves with 64 contacts in one call, every tool in one run; BLAS has one thread, others all cores."""

import os
from contextlib import suppress

import jax

from .comparison import Comparison, factorisation
from .harness import Question, set_up, with_one_blas_thread
from .peers import superlu
from .problems import Problem
from .tools import CONTACTS


def work(problem: Problem, image: str) -> dict[str, float]:
    """A factorisation for each contact."""
    return {name: CONTACTS * value for name, value in factorisation(problem).items()}


def with_a_device_for_each_core() -> None:
    """`harness.set_up`, and a device of JAX for each core, of which `jaxeit.bind_many` uses all, and others the first.

    Where JAX has computed before, as in the tests, the number of its devices stays as it is.
    """
    set_up()
    with suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)


BATCHES = Comparison("batch", superlu.NAME, "voltages", work, repeats=5, largest=120)
main = Question("batch", __doc__, {"rows": BATCHES}, prepare=with_a_device_for_each_core)

if __name__ == "__main__":
    with_one_blas_thread()
    main()
