"""The table of hard cases: tests record the severity they reached, and ``pytest --hard-cases PATH`` writes the table.

The report of each test carries its rows, so that rows from parallel workers are collected too.
"""

import math
import os
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import pytest

PROPERTY = "hard case"
INTRODUCTION = """\
# Hard cases

Each row is an extreme input that the tests compute with: how extreme it was, the largest error, and what a user sees
at that severity or beyond it. Rows "fault" are faults of devices, disks and processes. Rows "lie" are recordings with
wrong data, and quote the message of `jaxeit check`. The tests write this table; the command runs the slow ones too:

    python -m pytest --hard-cases docs/hard-cases.md

If all tests of a run pass, their rows replace the rows of the same cases. All other rows stay, so test files may be
run one at a time. A run that selects tests by `-m` or `-k` only adds rows of new cases, because it may omit some tests
of a known case. `python -m tests.mutations` removes the checks behind these rows one at a time, in a copy of the
repository, and names those whose removal no test detects.

Each error is the largest over all severities reached, relative to the largest of the compared values unless the case
says otherwise. "Naive" is the textbook form of the same computation; the test keeps it to show that it fails. A dash
means that this error is not measured.

"""
HEADER = ("case", "severity reached", "error, float64", "error, float32", "error, naive form", "what the user sees")


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
        lines = lines_of(table(merge(self.rows)))
        known = lines_of(self.path.read_text()) if self.path.exists() else {}
        if self.picked:
            lines = {case: line for case, line in lines.items() if case not in known}
        replace(self.path, INTRODUCTION + table([]) + "".join(line for _, line in sorted((known | lines).items())))
        self.said = f"hard cases: {len(lines)} written to {self.path}"

    def pytest_terminal_summary(self, terminalreporter) -> None:
        terminalreporter.write_line(self.said)


def merge(rows: list[Row]) -> list[Row]:
    """Merge to one row per case, sorted: the worst error of each kind, and every distinct text once."""
    alike = defaultdict(list)
    for row in rows:
        alike[row.case].append(row)
    return [_merged(case, alike[case]) for case in sorted(alike)]


def _merged(case: str, rows: list[Row]) -> Row:
    reached, beyond = ("; ".join(sorted({getattr(r, field) for r in rows})) for field in ("reached", "beyond"))
    float64, float32, naive = (worst([getattr(r, field) for r in rows]) for field in ("float64", "float32", "naive"))
    return Row(case, reached, float64, float32, naive, beyond)


def worst(errors: list[float | None]) -> float | None:
    """The largest known error; NaN counts as infinite."""
    known = [math.inf if math.isnan(e) else e for e in errors if e is not None]
    return max(known, default=None)


def table(rows: list[Row]) -> str:
    """The rows as a table in Markdown."""
    lines = [HEADER, ("---",) * len(HEADER)]
    lines += [(r.case, r.reached, *map(_number, (r.float64, r.float32, r.naive)), r.beyond) for r in rows]
    return "".join("| " + " | ".join(_cell(text) for text in line) + " |\n" for line in lines)


def lines_of(text: str) -> dict[str, str]:
    """The rows of a table in Markdown, by the text of their first cell."""
    lines = [line for line in text.splitlines(keepends=True) if line.startswith("| ")][2:]
    return {line.split(" | ")[0]: line for line in lines}


def _number(error: float | None) -> str:
    if error is None:
        return "–"
    return f"{error:.0e}" if math.isfinite(error) else "not finite"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def replace(path: Path, text: str) -> None:
    """Write a whole file or none."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=path.name, delete=False, encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)
