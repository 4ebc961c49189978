"""Jacobians of every tool on the same work, in one run: onto elements, and onto 30 x 30 pixels."""

from .comparison import Comparison, jacobian_work
from .harness import Question
from .peers import adjoint

JACOBIANS = Comparison("jacobian", adjoint.NAME, "Jacobians", jacobian_work, 15, ("pixels", "elements"))
main = Question("jacobian", __doc__, {"rows": JACOBIANS})

if __name__ == "__main__":
    main()
