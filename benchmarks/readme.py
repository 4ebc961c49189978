"""Write the tables of the README and of docs/, and their pictures: from the bundled session, and from results/.

python -m benchmarks.readme
"""

import calib
from calib.report.figures.parts import write_figure
from calib.report.figures.presses import sensitivity_figure
from calib.runtime import set_up
from calib.session import replacing

from .cost_pictures import draw
from .harness import ROOT, measured
from .markdown import replaced
from .tables import filled, table

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


def main() -> None:
    set_up()
    with calib.open_session(ROOT / "data" / "sessions" / "testbed_grid.h5") as session:
        calibration = calib.calibrate([session], recipe=calib.Recipe(location=calib.PadEdgeSpline()))
    results, stored = table("results", calibration.evaluation.summary()), measured()
    for page in PAGES:
        text = filled(replaced(page.read_text(encoding="utf-8"), "results", results), stored)
        with replacing(page) as new:
            new.write_text(text, encoding="utf-8")
    draw(stored)
    figure = sensitivity_figure(calibration.evaluation, calibration.skin, simulated=True)
    write_figure(figure, ROOT / "docs" / "sensitivity.png")


if __name__ == "__main__":
    main()
