"""A campaign of generated lies (`tests.campaign`), in a process of its own: none is silent, none breaks a command."""

import json
import os
import subprocess
import sys

import pytest

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


def test_some_lies(root):
    judged(campaign(60, 1, root, 100), 60)


@pytest.mark.slow
def test_ten_thousand_lies(root, hard):
    found = campaign(10_000, 2, root, 7200)
    judged(found, 10_000)
    total = found["total"]
    hard(
        "a campaign of lies",
        "10,000 generated: recordings, descriptions, calibrations, tables, devices",
        beyond=f"{total['refused']:,} refused, {total['said']:,} named, {total['harmless']:,} without effect",
    )
