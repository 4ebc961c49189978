"""A campaign of generated lies (`tests.campaign`), in a process of its own: none is silent, none breaks a command."""

import json
import os
import subprocess
import sys

import pytest

from ..campaign.joined import CASE, joined, write
from ..hard_cases import Row, cells_of, document, table

KINDS = 5  # of input, told in turn


def campaign(count, seed, root, timeout):
    """The summary of a campaign."""
    command = [sys.executable, "-W", "ignore", "-m", "tests.campaign", str(count), str(seed)]
    done = subprocess.run(
        command, cwd=root, env=dict(os.environ), capture_output=True, text=True, timeout=timeout, check=False
    )
    assert done.returncode in (0, 1), done.stderr[-2000:]
    return json.loads(done.stdout)


def judged(found, count):
    assert not found["failures"], json.dumps(found["failures"], indent=1)
    assert found["lies"] == count
    assert len(found["counts"]) == KINDS
    for family, verdicts in found["counts"].items():
        assert verdicts.get("refused", 0) + verdicts.get("said", 0) >= count / KINDS / 4, family


@pytest.mark.slow
def test_some_lies(root):
    judged(campaign(10, 1, root, 600), 10)


@pytest.mark.slow
def test_a_thousand_lies(root):
    """The table of hard cases has the row of more, told in parts (`tests.campaign.joined`)."""
    judged(campaign(1000, 2, root, 3600), 1000)


def part(seed, first, lies, **changes):
    """The summary of one part of a campaign."""
    extreme = {"seconds": lies / 100, "grown": 1_000_000 * lies}
    counts = {"table": {"refused": lies - 3, "said": 2, "harmless": 1}}
    parts = {"total": counts["table"], "counts": counts, "seconds": 1.0, "slowest": extreme, "largest": extreme}
    return {"seed": seed, "first": first, "lies": lies, "failures": [], **parts, **changes}


def test_campaigns_are_joined_to_one_row(tmp_path):
    found = joined([part(1, 0, 100), part(1, 100, 50), part(2, 0, 30)])
    path = tmp_path / "table.md"
    old = [Row("a", "b", 1e-9, None, None, "c"), Row(CASE, "old", None, None, None, "x")]
    path.write_text(document(cells_of(table(old))))
    write(path, found)
    seen = "171 refused, 6 named, 3 without effect, none silent; slowest 1.0 s of the processor"
    new = Row(CASE, "180 generated: 180 tables", None, None, None, f"{seen}, largest growth of memory 100 MB")
    assert path.read_text() == document(cells_of(table([old[0], new])))
    assert path.read_text().endswith(f"| {new.case} | {new.reached} | {new.beyond} |\n")


def test_no_lie_is_counted_twice_and_no_failure_is_written(tmp_path):
    with pytest.raises(ValueError, match="lie 60 of seed 1 was told twice"):
        joined([part(1, 0, 100), part(1, 60, 100)])
    with pytest.raises(ValueError, match="1 lies were silent"):
        write(tmp_path / "table.md", joined([part(1, 0, 5, failures=["SILENT"])]))
