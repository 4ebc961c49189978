"""Everything that reads, offered what no one should: refused in one line, in bounded time and memory, or read right.

The inputs are made and read in a process of their own (`tests.fuzzing`), whose memory is limited once the libraries
are loaded; a crash, a hang or an error of another kind is a failure of the test.
"""

import json
import os
import resource
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest
from h5py import h5g

import jaxeit as je
from calib.bench import write_data_set
from calib.calibration.calibration import load_calibration
from calib.session import SessionError, read_archive, write_archive
from tests.fuzzing import MEMORY, READERS, calibration, reconstructor
from tests.session.test_session import ARRAYS, FORCE, REFUSED_FILES, changed, everything, make, put_chunk, replace

SLOW = {"session": 10_000, "calibration": 2000, "journal": 5000, "hostile journal": 5000, "frames": 4000, "lines": 4000}
LONGEST = 60.0  # seconds for one input, of a hang; refused in milliseconds, but one that is read may compile a program


def campaign(kinds, count, seed, folder, root, timeout):
    """Results by kind, of one process."""
    command = [sys.executable, "-W", "ignore", "-m", "tests.fuzzing", str(count), str(seed), str(folder), *kinds]
    environment = os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, timeout=timeout, check=False
    )
    assert done.returncode == 0, f"{kinds}: {done.returncode}: {done.stderr[-2000:]}"
    return json.loads(done.stdout.splitlines()[-1])


def judged(found):
    for kind, result in found.items():
        assert not result["broken_ones"], f"{kind}: {result['broken_ones']}"
        assert result.get("refused", 0) > 0 or kind in ("frames", "lines"), kind
        assert result["longest"] < LONGEST, f"{kind}: one took {result['longest']:.1f} s"
        assert result["grown"] < MEMORY / 4, f"{kind}: {result['grown']:,} bytes more"
        if READERS[kind].sealed:
            assert result.get("different", 0) == 0, f"{kind}: damaged and read as something else"


def test_some_spoilt_inputs(tmp_path, root):
    """Of the kinds whose readers compile nothing."""
    compiled = {"calibration", "hostile calibration", "reconstructor", "hostile reconstructor"}
    judged(campaign([kind for kind in READERS if kind not in compiled], 15, 1, tmp_path, root, 100))


@pytest.mark.slow
@pytest.mark.parametrize("kind", READERS)
def test_thousands_of_spoilt_inputs(kind, tmp_path, root, hard):
    count = SLOW.get(kind, 1000)
    found = campaign([kind], count, 2, tmp_path, root, 1800)
    print(f"{kind}: {count:,} inputs, {found[kind]}")
    judged(found)
    beyond = "what is damaged is dropped and counted, the rest is read"  # of streams, which have no end
    if READERS[kind].errors:
        rest = "; none is read as something else" if READERS[kind].sealed else ", or what is there is read"
        beyond = "one line that says what is wrong" + rest
    hard(f"spoilt input: {kind}", f"{count:,} inputs", beyond=beyond)


DEEP, WIDE = 20_000, 100_000


def deep(name):
    """Groups within groups."""

    def change(file):
        group = file.require_group(name).id
        for _ in range(DEEP):
            group = h5g.create(group, b"a")

    return change


def wide(name):
    """A group of that many members, of those it has and links."""

    def change(file):
        group = file.require_group(name)
        for i in range(WIDE - len(group)):
            group.id.links.create_soft(b"x%d" % i, b"/")

    return change


def gigabyte(file):
    """A megabyte that unfolds a thousandfold."""
    squeeze = zlib.compressobj(9)
    put_chunk(file, b"".join(squeeze.compress(bytes(1 << 20)) for _ in range(1 << 10)) + squeeze.flush())


LINKS = """external storage, soft link, external link, link cycle, virtual dataset, objects, references, compound,
unknown filter, attribute of references"""
HOSTILE = {
    **{name: REFUSED_FILES[name] for name in LINKS.replace("\n", " ").split(", ")},
    "a stream of groups 20,000 deep": (deep("streams/deep"), "/streams/deep: "),
    "a root of 100,000 members": (wide("/"), "/: has 100,000 members"),
    "100,000 streams": (wide("streams"), "/streams: has 100,000 members"),
    "2.4 TB": (replace(FORCE, shape=(300_000_000_000, 1), dtype="f8"), "claims 2,400,000,000,000 bytes"),
    "a chunk of 1 GB": (replace(FORCE, shape=(1 << 27, 1), dtype="f8", chunks=(1 << 27, 1)), "claims 1,073,741,824 b"),
    "1 MB of gzip for 1 GB": (gigabyte, "too long"),
}
HOSTILE_RESULTS = {
    "groups 20,000 deep": (deep("deep"), "/deep/a/a/a: holds too many or too deeply nested arrays"),
    "a root of 100,000 members": (wide("/"), "/: has 100,000 members"),
    "100,000 pads": (wide("pads"), "/pads: has 100,000 members"),
}


@pytest.mark.slow
def test_hostile_files_are_refused_by_name_and_at_once(tmp_path, hard):
    good, result = make(tmp_path / "good.h5"), tmp_path / "result.h5"
    write_archive(result, "skin-calibration", {}, ARRAYS)
    everything(good)  # what is imported or compiled once
    files = [
        *((good, everything, case) for case in HOSTILE.values()),
        *((result, lambda path: read_archive(path, "skin-calibration"), case) for case in HOSTILE_RESULTS.values()),
    ]
    longest = max(_seconds(read, changed(path, tmp_path, change), said) for path, read, (change, said) in files)
    assert longest < 10
    hard(
        "hostile files",
        f"{len(files)} kinds: links, cycles, other types and filters; 20,000 deep, 100,000 wide; 1 MB for 1 GB, 2.4 TB",
        beyond=f"one line that names the place, within {_rounded(longest)} ms here",
    )


def _seconds(read, path, said):
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    with pytest.raises(SessionError) as caught:
        read(path)
    seconds, line = time.perf_counter() - start, str(caught.value)
    assert said in line
    assert "\n" not in line
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < MEMORY / 4
    return seconds


def _rounded(seconds):
    """Milliseconds, up to the next of 10, 20, 50, 100 ..."""
    return next(ms for power in range(1, 9) for n in (1, 2, 5) if (ms := n * 10**power) >= 1000 * seconds)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    calibration(folder)
    return folder / "good.h5"


def test_numbers_of_another_kind_are_refused_by_name(tmp_path):
    reconstructor(tmp_path)
    with np.load(tmp_path / "good.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "bad.npz", **arrays | {"factor": arrays["factor"].astype(int)})
    with pytest.raises(je.imaging.StorageError, match="factor: is of type int64; it must be"):
        je.load_reconstructor(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.pop("pads/parameters"), "pads/parameters: missing from the calibration"),
        (
            replace("pads/parameters", data=np.zeros((3, 2))),
            r"fit each other \(.* float64 of shape \(3, 2\), not numbers",
        ),
        (replace("image/factor", data=np.zeros((4, 6), int)), "image/factor: is of type int64; it must be"),
    ],
)
def test_calibrations_whose_numbers_do_not_fit_are_refused(calibrated, tmp_path, change, said):
    with pytest.raises(SessionError, match=rf"^changed\.h5: .*{said}.*; calibrate again$"):
        load_calibration(changed(calibrated, tmp_path, change))


def test_of_nothing_no_file_is_made(skin, tmp_path):
    with pytest.raises(ValueError, match="0 x 41 places in 11 steps make no data set; give one place and two steps"):
        write_data_set(skin, tmp_path / "d.h5", columns=0)
    assert not os.listdir(tmp_path)
