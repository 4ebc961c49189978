"""The table of hard cases: tests record the severity they reached, and ``pytest --hard-cases PATH`` writes the table.

The report of each test carries its rows, so that rows from parallel workers are collected too.
"""

import math
import os
import re
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import pytest

PROPERTY = "hard case"
Cells = tuple[str, ...]  # of a row of a table
INTRODUCTION = """\
# Hard cases

What happens where a problem is as hard as it gets? Each chapter gives an answer and a table. Each row of a table is
an extreme that the tests go to: how severe it is, and what a user sees at that severity or beyond it.

<details markdown="1">
<summary>How the tables are written</summary>

The tests write them; the command runs the slow ones too:

    python -m pytest --hard-cases docs/hard-cases.md

If all tests of a run pass, their rows replace the rows of the same cases. All other rows stay, so test files may be
run one at a time. A run that selects tests by `-m` or `-k` only adds rows of new cases, because it may omit some
tests of a known case. `python -m tests.mutations` removes the checks behind these rows one at a time, in a copy of
the repository, and names those whose removal no test detects. `python -m benchmarks.stability` draws the first
picture, and `python -m benchmarks.hard_case_pictures` draws the others from the tables.

</details>
"""
HEADER = ("case", "severity reached", "error, float64", "error, float32", "error, naive form", "what the user sees")
NONE = "–"  # an error that is not measured


@dataclass(frozen=True)
class Chapter:
    """A question that cases answer whose names begin so, without the columns of errors if they have none.

    ``end`` stands below the table.
    """

    text: str
    beginnings: tuple[str, ...]
    errors: bool = False
    end: str = ""


CHAPTERS = (
    Chapter(
        """
## Are numbers right where problems are hardest?

Yes, to rounding times the condition of the problem. Where most digits are lost, an error or `je.model.rounding` says
so. The picture shows error against severity, beside the textbook form of the same computation, which the tests keep
to show that it fails ("naive"). Each error is the largest over all severities reached, relative to the largest of the
compared values unless the case says otherwise.

![Error against severity for nine hard axes: float64, float32 and the naive form](stability.png)

""",
        (),
        errors=True,
    ),
    Chapter(
        """
## Is wrong data noticed?

Yes, with the exceptions below. Spoilt files are refused. A *lie* is a recording, a description, a calibration or a
table whose numbers are well formed but cannot be true, or a device that sends such numbers. Lies are refused, or
`jaxeit check` names them. Of the lies that the tests generated, none that changed a result passed unnoticed.

![Lies in each part of a recording: how many end in an error, how many in a warning](lies.png)

No recording can tell these faults:

- all changes of EIT have the wrong sign;
- a gain that all readings of EIT have in common is wrong by less than a factor of 3, or of force or pressure by
  less than a factor of 30 and the table of presses says nothing of forces: an air pad under a small tip bears its
  force by a part of its area;
- the tare of the load cell is wrong;
- all pads share an offset of 2 kPa;
- a grid of presses is numbered from the opposite corner.

A clock of EIT that is late by less than 0.3 of the ramp and two frames is not named, 0.22 s for ramps of 0.4 s at 20
Hz. It costs a calibration nothing: on the simulated testbed forces held out stay at 0.34 N (RMSE) and fitted places
at 0.2 mm with EIT late by 0.2, 0.4 or 0.6 s. What follows a touch that moves, `apply` and `live`, is late by that
time.

""",
        ("a campaign", "hostile files", "lies:", "spoilt input:", "unsound meshes"),
    ),
    Chapter(
        """
<details markdown="1">
<summary>Each way in which a recording is untrue, and the message of <code>jaxeit check</code></summary>

""",
        ("lie:",),
        end="\n</details>\n",
    ),
    Chapter(
        """
## What survives a fault of a device, a disk or a process?

Recordings survive, except for the last moments before a crash or a power cut; the rows say how long these moments
are. What a device loses is counted and flagged.

![How long a fault lasts, or how far times are off after it, from microseconds to a second](faults.png)

""",
        ("fault", "no network", "two threads"),
    ),
)


@dataclass(frozen=True)
class Row:
    """Result of one test for one hard case; the rows of a case are merged to one, with the worst errors."""

    case: str
    reached: str
    float64: float | None
    float32: float | None
    naive: float | None
    beyond: str


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--hard-cases", metavar="PATH", type=Path, help="write the table of hard cases, Markdown")


@pytest.fixture
def hard(record_property):
    """``hard(case, reached, float64=, float32=, naive=, beyond=)`` adds a row; errors are numbers or None."""

    def note(case, reached, *, float64=None, float32=None, naive=None, beyond):
        errors = (None if e is None else float(e) for e in (float64, float32, naive))
        record_property(PROPERTY, (case, reached, *errors, beyond))

    return note


def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("hard_cases")
    if path and not hasattr(config, "workerinput"):  # parallel workers leave it to their controller
        if path.suffix != ".md":
            raise pytest.UsageError(f"--hard-cases {path}: not written over; name the table, docs/hard-cases.md")
        picked = bool(config.getoption("markexpr") or config.getoption("keyword"))
        config.pluginmanager.register(_Collector(path, picked))


class _Collector:
    """Collects the rows of tests that passed; at the end they replace the rows of the same cases in the file.

    If the tests were ``picked`` by an option, only rows of cases that are not in the file are added.
    """

    def __init__(self, path: Path, picked: bool) -> None:
        self.path, self.picked = path, picked
        self.rows: list[Row] = []
        self.said = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" and report.passed:
            self.rows += [Row(*value) for name, value in report.user_properties if name == PROPERTY]

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        if exitstatus != pytest.ExitCode.OK:
            self.said = f"hard cases: {self.path} is left as it was, as not all tests passed"
            return
        rows = cells_of(table(merge(self.rows)))
        known = cells_of(self.path.read_text()) if self.path.exists() else {}
        if self.picked:
            rows = {case: cells for case, cells in rows.items() if case not in known}
        replace(self.path, document(known | rows))
        self.said = f"hard cases: {len(rows)} written to {self.path}"

    def pytest_terminal_summary(self, terminalreporter) -> None:
        terminalreporter.write_line(self.said)


def merge(rows: list[Row]) -> list[Row]:
    """Merge to one row per case, sorted: the worst error of each kind, and every distinct text once."""
    alike = defaultdict(list)
    for row in rows:
        alike[row.case].append(row)
    return [_merged(case, alike[case]) for case in sorted(alike)]


def _merged(case: str, rows: list[Row]) -> Row:
    reached, beyond = (_together({getattr(r, field) for r in rows}) for field in ("reached", "beyond"))
    float64, float32, naive = (worst([getattr(r, field) for r in rows]) for field in ("float64", "float32", "naive"))
    return Row(case, reached, float64, float32, naive, beyond)


def _together(texts: set[str]) -> str:
    """All parts of the texts, each once."""
    return "; ".join(dict.fromkeys(part for text in sorted(texts) for part in text.split("; ")))


def worst(errors: list[float | None]) -> float | None:
    """The largest known error; NaN counts as infinite."""
    known = [math.inf if math.isnan(e) else e for e in errors if e is not None]
    return max(known, default=None)


def table(rows: list[Row]) -> str:
    """The rows as a table in Markdown."""
    return _markdown(
        [(r.case, r.reached, *map(_number, (r.float64, r.float32, r.naive)), r.beyond) for r in rows], errors=True
    )


def document(rows: dict[str, Cells]) -> str:
    """The page of the tables: each row in the first chapter that its case belongs to, the first chapter if none."""
    chapters = defaultdict(list)
    for case, cells in sorted(rows.items()):
        found = (chapter for chapter in CHAPTERS if case.startswith(chapter.beginnings))
        chapters[next(found, CHAPTERS[0])].append(cells)
    return INTRODUCTION + "".join(
        chapter.text + _markdown(chapters[chapter], chapter.errors) + chapter.end
        for chapter in CHAPTERS
        if chapters[chapter]
    )


def _markdown(rows: list[Cells], errors: bool) -> str:
    lines = [HEADER, ("---",) * len(HEADER), *rows]
    kept = [line if errors else (*line[:2], line[-1]) for line in lines]
    return "".join("| " + " | ".join(_cell(text) for text in line) + " |\n" for line in kept)


def cells_of(text: str) -> dict[str, Cells]:
    """The rows of all tables in Markdown by the text of their first cell, with all columns."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    rows = [tuple(line[2:-2].split(" | ")) for line in lines]
    every = [row if len(row) == len(HEADER) else (*row[:2], NONE, NONE, NONE, row[-1]) for row in rows]
    return {row[0]: row for row in every if row[0] not in (HEADER[0], "---")}


def _number(error: float | None) -> str:
    if error is None:
        return NONE
    return f"{error:.0e}" if math.isfinite(error) else "not finite"


def _cell(text: str) -> str:
    return " ".join(re.sub(r"(?<!\\)\|", r"\\|", text).split())


def replace(path: Path, text: str) -> None:
    """Write a whole file or none."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=path.name, delete=False, encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)
