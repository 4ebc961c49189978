"""Everything that reads, offered what no one should: refused in one line, in bounded time and memory, or read right.

The inputs are made and read in a process of their own (`tests.fuzzing`), whose memory is limited once the libraries
are loaded; a crash, a hang or an error of another kind is a failure of the test.
"""

import json
import os
import subprocess
import sys

import pytest

from tests.fuzzing import MEMORY, READERS

SLOW = {"session": 10_000, "calibration": 2000, "journal": 2000, "frames": 4000, "lines": 4000}
LONGEST = 5.0  # seconds for one input; one that is refused takes milliseconds, one that is read may compile a program


def campaign(kinds, count, seed, folder, root, timeout):
    """Results by kind, of processes one after the other."""
    found = {}
    for kind in kinds:
        place = folder / kind.replace(" ", "_")
        place.mkdir()
        command = [sys.executable, "-W", "ignore", "-m", "tests.fuzzing", kind, str(count[kind]), str(seed), str(place)]
        environment = os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"}
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=timeout, check=False
        )
        assert done.returncode == 0, f"{kind}: {done.returncode}: {done.stderr[-2000:]}"
        found[kind] = json.loads(done.stdout.splitlines()[-1])
    return found


def judged(found):
    for kind, result in found.items():
        assert not result["broken_ones"], f"{kind}: {result['broken_ones']}"
        assert result.get("refused", 0) > 0 or kind in ("frames", "lines"), kind
        assert result["longest"] < LONGEST, f"{kind}: one took {result['longest']:.1f} s"
        assert result["grown"] < MEMORY / 4, f"{kind}: {result['grown']:,} bytes more"
        if READERS[kind].sealed:
            assert result.get("different", 0) == 0, f"{kind}: damaged and read as something else"


QUICK = ["skin"]


@pytest.mark.parametrize("kind", QUICK)
def test_some_spoilt_inputs(kind, tmp_path, root):
    judged(campaign([kind], {kind: 120}, 1, tmp_path, root, 100))


@pytest.mark.slow
@pytest.mark.parametrize("kind", READERS)
def test_thousands_of_spoilt_inputs(kind, tmp_path, root, hard):
    count = SLOW.get(kind, 1000)
    found = campaign([kind], {kind: count}, 2, tmp_path, root, 900)
    print(f"{kind}: {count:,} inputs, {found[kind]}")
    judged(found)
    beyond = "one line that says what is wrong" + (
        "; none is read as something else" if READERS[kind].sealed else ", or what is there is read"
    )
    hard(f"spoilt input: {kind}", f"{count:,} inputs", beyond=beyond)
