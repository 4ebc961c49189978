"""Write the tables of the README and of docs/: the accuracy from the bundled session, the others from results/.

python -m benchmarks.readme
"""

import json
from pathlib import Path

import calib
from calib.report.figures.parts import write_figure
from calib.report.figures.presses import sensitivity_figure
from calib.runtime import set_up
from calib.session import replacing

from .markdown import replaced
from .rows import Row
from .tables import filled, table

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
MAIN = "2-core-x86"  # the machine of all sections that it has measured


def measured() -> Row:
    """The sections of all machines."""
    files = sorted((ROOT / "benchmarks" / "results").glob("*.json"), key=lambda file: file.stem == MAIN)
    return {name: data for file in files for name, data in json.loads(file.read_text(encoding="utf-8")).items()}


def main() -> None:
    set_up()
    with calib.open_session(ROOT / "data" / "sessions" / "testbed_grid.h5") as session:
        calibration = calib.calibrate([session], recipe=calib.Recipe(location=calib.PadEdge()))
    results = table("results", calibration.evaluation.summary())
    for page in PAGES:
        text = filled(replaced(page.read_text(encoding="utf-8"), "results", results), measured())
        with replacing(page) as new:
            new.write_text(text, encoding="utf-8")
    figure = sensitivity_figure(calibration.evaluation, calibration.skin, simulated=True)
    write_figure(figure, ROOT / "docs" / "sensitivity.png")


if __name__ == "__main__":
    main()
