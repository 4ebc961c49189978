"""From the mesh to images of 100 frames with every tool, in one run.

Nodes, triangles, electrodes, pairs and 100 frames are given as arrays; the result is the images by one-step NOSER,
linearised at a conductivity that varies.  Every tool repeats in each call what depends on the mesh; ours is timed with
its programs compiled (`first_call_s` holds the compilation).  Tools without pixels are given the projection.
"""

from .clock import require_agreement
from .comparison import Comparison, inverse_work
from .harness import Question
from .peers import eidors, pyeit
from .problems import Problem
from .tools import FORWARD, IN_IMAGE, present

VOLTAGES = [entry for entry in FORWARD if entry.name in ("jaxeit float64", eidors.NAME, pyeit.NAME)]


def voltages(cells: int) -> dict[str, float]:
    """How far the tools' voltages are from ours, before anything is timed."""
    problem = Problem(cells)
    print(f"{len(problem.mesh.nodes)} nodes; largest difference of the voltages")
    found = {entry.name: entry.prepare(problem)(problem.sigma) for entry in present(VOLTAGES, cells)}
    return require_agreement(found, VOLTAGES[0].name, {})


ONTO = ("pixels", "elements")
PIPELINES = Comparison("pipeline", IN_IMAGE, "images", inverse_work, 5, ONTO, voltages=voltages)
main = Question("pipeline", __doc__, {"rows": PIPELINES})

if __name__ == "__main__":
    main()
