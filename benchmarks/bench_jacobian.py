"""Jacobians of every tool on the same work, in one run, onto elements and onto 30 x 30 pixels; gradients of a loss."""

from collections.abc import Iterator

from .comparison import Comparison, gradient_work, jacobian_work
from .harness import Question, Run
from .peers import adjoint
from .rows import Row

JACOBIANS = Comparison("jacobian", adjoint.NAME, "Jacobians", jacobian_work, 15, ("pixels", "elements"))
GRADIENTS = Comparison("gradient", adjoint.NAME, "gradients", gradient_work, 15)


def gradients(run: Run) -> Iterator[Row]:
    """The rows of `GRADIENTS`, beside those of the Jacobians."""
    return ({f"gradient_{key}": found for key, found in piece.items() if key != "limits"} for piece in GRADIENTS(run))


main = Question("jacobian", __doc__, {"rows": JACOBIANS, "gradients": gradients})

if __name__ == "__main__":
    main()
