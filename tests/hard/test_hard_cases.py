"""The table of hard cases: whole, the same each time, and never of a run that failed."""

import math
import os
import subprocess
import sys
import textwrap

import pytest

from ..hard_cases import INTRODUCTION, Row, cells_of, document, merge, table, worst

SUITE = """
    import pytest

    @pytest.mark.parametrize("error", [1e-9, 3e-12, float("nan")])
    def test_contacts(hard, error):
        hard("contact resistance", "1e-12 to 1e8", float64=1e-9, naive=error, beyond="nothing | more")

    def test_slivers(hard):
        hard("angle", "1 degree", float32=2e-4, beyond="one error that names it")

    def test_wrong(hard):
        hard("angle", "0 degrees", beyond="nothing")
        assert False
"""


@pytest.fixture
def run(tmp_path, root):
    """Runs of a small suite of its own, which say what they did at the end."""
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["tests.hard_cases"]')
    (tmp_path / "test_suite.py").write_text(textwrap.dedent(SUITE))

    def run(*args):
        command = [sys.executable, "-m", "pytest", "-p", "xdist", "-p", "no:cacheprovider", "--hard-cases", "table.md"]
        quiet = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST")}
        env = quiet | {"PYTHONPATH": str(root), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        done = subprocess.run([*command, *args], cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr, (tmp_path / "table.md")

    return run


def test_rows_of_all_workers_make_one_table(run):
    said, path = run("-n", "2", "-k", "not wrong")
    assert "hard cases: 2 written to table.md" in said
    text = path.read_text()
    assert text.startswith(INTRODUCTION)
    assert text.splitlines()[-2:] == [
        "| angle | 1 degree | – | 2e-04 | – | one error that names it |",
        "| contact resistance | 1e-12 to 1e8 | 1e-09 | – | not finite | nothing \\| more |",
    ]


def test_a_run_replaces_the_rows_of_its_own_cases(run, tmp_path):
    old = table(
        [Row("angle", "9 degrees", None, None, None, "nothing"), Row("zeal", "1", None, None, None, "no \\| end")]
    )
    (tmp_path / "table.md").write_text("# Another introduction\n\n" + old)
    _, path = run("test_suite.py::test_slivers")
    text = path.read_text()
    assert text.startswith(INTRODUCTION)
    assert text.splitlines()[-2:] == [
        "| angle | 1 degree | – | 2e-04 | – | one error that names it |",
        old.splitlines()[-1],
    ]


@pytest.mark.parametrize("how", ["-k", "-m"])
def test_a_run_of_picked_tests_leaves_the_rows_of_cases_that_are_there(run, tmp_path, how):
    old = table([Row("angle", "9 degrees", None, None, None, "nothing")])
    (tmp_path / "table.md").write_text(old)
    said, path = run(how, "not wrong", "--deselect", "test_suite.py::test_wrong")
    assert "hard cases: 1 written to table.md" in said
    rows = path.read_text().splitlines()[-2:]
    assert rows[0] == old.splitlines()[-1]
    assert rows[1].startswith("| contact resistance | 1e-12 to 1e8 |")


def test_a_run_that_failed_leaves_the_table_as_it_was(run, tmp_path):
    (tmp_path / "table.md").write_text("as it was")
    said, path = run()
    assert "table.md is left as it was, as not all tests passed" in said
    assert path.read_text() == "as it was"
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["conftest.py", "table.md", "test_suite.py"]


def test_rows_of_a_case_merge_to_the_worst_in_any_order():
    rows = [
        Row("b", "1e3", 1e-9, None, 0.1, "an error"),
        Row("a", "2", None, None, None, "nothing"),
        Row("b", "1e4", 1e-12, 1e-3, math.nan, "an error; no file"),
    ]
    beyond = "an error; no file"
    merged = [Row("a", "2", None, None, None, "nothing"), Row("b", "1e3; 1e4", 1e-9, 1e-3, math.inf, beyond)]
    assert merge(rows) == merge(rows[::-1]) == merged
    assert table(merged).splitlines()[-1] == f"| b | 1e3; 1e4 | 1e-09 | 1e-03 | not finite | {beyond} |"
    assert worst([None]) is None


def test_a_file_of_tests_is_not_written_over(run, tmp_path):
    """Where the path was forgotten."""
    said, _ = run("--hard-cases", "test_suite.py")
    assert "--hard-cases test_suite.py: not written over" in said
    assert (tmp_path / "test_suite.py").read_text() == textwrap.dedent(SUITE)


def test_the_page_says_what_is_written_around_its_tables(root):
    page = (root / "docs" / "hard-cases.md").read_text(encoding="utf-8")
    assert page == document(cells_of(page))
