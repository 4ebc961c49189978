"""Forward solves of every tool on the same work, in one run."""

from .comparison import Comparison, factorisation
from .harness import Question
from .levels import levels
from .peers import superlu

FORWARDS = Comparison("forward", superlu.NAME, "voltages", factorisation, repeats=15)
main = Question("forward", __doc__, {"rows": FORWARDS, "levels": levels})

if __name__ == "__main__":
    main()
