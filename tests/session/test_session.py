"""Session and result files: what is written comes back, and what is not sound is refused."""

import errno
import io
import os
import pickle
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5netcdf
import h5py
import numpy as np
import pytest
from h5py import h5d, h5p, h5s, h5t
from hypothesis import HealthCheck, given, settings, strategies as st

import calib.session.archive as archive
from calib.check import check_session
from calib.session import (
    ArchiveWriter,
    ClockTable,
    PressTable,
    Session,
    SessionError,
    SessionFacts,
    SessionWriter,
    Status,
    StreamFacts,
    file_hash,
    open_archive,
    open_session,
    read_archive,
    replacing,
    write_archive,
)
from calib.session.hdf5.chunks import checksum_holds
from calib.session.outputs import folder_beside

EPOCH = datetime(2025, 1, 1, 12, tzinfo=UTC)
PATTERN = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 0]])
PRESSES = PressTable(
    x=np.array([0.1, 0.2]),
    y=np.array([0.0, 0.05]),
    tip_diameter=np.array([0.02, 0.02]),
    target_force=np.array([1.0, 20.0]),
    t_press=np.array([1, 5]),
    t_hold0=np.array([2, 6]),
    t_hold1=np.array([3, 7]),
    t_release=np.array([4, 8]),
    pad=np.array([3, -1]),
    accepted=np.array([True, False]),
    reason=("", "no contact <é>"),
)


def options(**changes: object) -> dict:
    """Arguments of `SessionWriter` for a small simulated session."""
    base = {"title": "a test", "skin_name": "bench", "skin_toml": "[skin]\nname = 'é'\n"}
    base |= {"pattern": PATTERN, "current": 1e-3, "frequency": 1e4, "offset": [0.0, 1e-3, 2e-3]}
    base |= {"epoch": EPOCH, "simulated": True, "scene": "[scene]", "seed": 3, "session_id": "id"}
    return base | changes


def samples(rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, voltages with a hole, forces with a hole and one beyond the range of i2."""
    rng = np.random.default_rng(rows)
    voltage, force = rng.normal(size=(rows, 3)), rng.normal(size=rows)
    voltage[5, 1] = force[3] = np.nan
    force[9] = 100.0
    return np.arange(rows) * 10_000_000 + rng.integers(0, 1000, rows), voltage, force


def fill(writer: SessionWriter, rows: int, step: int) -> None:
    """Add two streams, presses, events and truth to an open writer."""
    time, voltage, force = samples(rows)
    writer.add_stream("eit", StreamFacts("voltage", units="V", channels=3, rate_hz=100))
    packing = {"dtype": "i2", "scale_factor": 1e-3, "add_offset": 0.5}
    writer.add_stream("force", StreamFacts("force", units="N", channels=1, rate_hz=100, **packing))
    for i in range(0, rows, step):
        writer.append("eit", time[i : i + step], voltage[i : i + step])
    writer.append("force", time, force, seq=np.arange(rows), time_host=time + 7)
    writer.set_presses(PRESSES)
    writer.set_truth({"site": (np.arange(6.0).reshape(2, 3), "m"), "gain": (3.0, "N")})
    writer.add_events([1, 2], [3, 4], ["start", "<b>end</b>"])


def make(path: Path, rows: int = 200, step: int = 7, **changes: object) -> Path:
    """A good session file."""
    with SessionWriter(path, SessionFacts(**options(**changes))) as writer:
        fill(writer, rows, step)
    return path


def everything(path: Path) -> list:
    """All that a session says, as values that can be compared."""
    with open_session(path) as s:
        found: list = [sorted(s.attrs.items()), s.skin_name, s.skin_toml, s.epoch_ns, s.scene]
        found += [None if a is None else a.tobytes() for a in (s.pattern, s.offset)]
        found += [s.current, s.frequency, s.complete]
        for name, stream in s.streams.items():
            arrays = [stream.time, stream.read(), stream.status(), stream.seq, stream.time_host]
            found += [name, stream.variable, stream.unit, stream.nominal_rate, stream.clock]
            found += [None if a is None else a.tobytes() for a in arrays]
        return [*found, repr(s.presses), repr(s.events), repr(dict(s.truth)), repr(dict(s.clocks))]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("good") / "good.h5")


@pytest.fixture
def session(good: Path) -> Session:
    with open_session(good) as opened:
        yield opened


# --- what is written comes back ------------------------------------------------------------------


def test_descriptions_come_back(session: Session) -> None:
    assert (session.title, session.skin_name, session.session_id) == ("a test", "bench", "id")
    assert session.skin_toml == "[skin]\nname = 'é'\n"
    assert session.simulated
    assert session.complete
    assert (session.scene, session.seed) == ("[scene]", 3)
    assert (session.current, session.frequency) == (1e-3, 1e4)
    np.testing.assert_array_equal(session.pattern, PATTERN)
    np.testing.assert_array_equal(session.offset, [0.0, 1e-3, 2e-3])
    assert session.epoch_ns == int(EPOCH.timestamp()) * 10**9
    assert set(session.streams) == {"eit", "force"}


def test_a_closed_session_says_so(good: Path) -> None:
    with open_session(good) as opened:
        eit = opened.streams["eit"]
    for read in (eit.read, lambda: opened.presses, lambda: check_session(opened)):
        with pytest.raises(SessionError, match="is read after its file was closed; read it before, inside the `with`"):
            read()


def test_samples_come_back_with_holes_and_flags(session: Session) -> None:
    time, voltage, force = samples(200)
    eit, stage = session.streams["eit"], session.streams["force"]
    np.testing.assert_array_equal(eit.time, time)
    np.testing.assert_array_equal(eit.read(), voltage.astype("f4").astype(float))
    assert np.flatnonzero(eit.status()).tolist() == [5]
    assert eit.status()[5] == Status.nonfinite
    keep = np.delete(np.arange(200), [3, 9])
    np.testing.assert_allclose(stage.read()[keep, 0], force[keep], atol=0.5001e-3)
    assert np.isnan(stage.read()[3, 0])
    assert stage.status()[3] == Status.nonfinite
    assert stage.status()[9] == Status.saturated
    assert stage.read()[9, 0] == pytest.approx(32.767 + 0.5)
    np.testing.assert_array_equal(stage.seq, np.arange(200))
    np.testing.assert_array_equal(stage.time_host, time + 7)
    assert stage.time_device is None


def test_tables_come_back(session: Session) -> None:
    assert repr(session.presses) == repr(PRESSES)
    assert session.events.label == ("start", "<b>end</b>")
    assert session.events.code.tolist() == [3, 4]
    np.testing.assert_array_equal(session.truth["site"], np.arange(6.0).reshape(2, 3))
    assert set(session.truth) == {"site", "gain"}
    assert session.truth["gain"] == 3.0


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    one, other = (make(tmp_path / name, 40_000, 977) for name in ("one.h5", "other.h5"))
    assert file_hash(one) == file_hash(other)
    assert everything(make(tmp_path / "at once.h5", 40_000, 40_000)) == everything(one)


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Several chunks along time, packed as i4 counts and read without a pattern."""
    path = tmp_path_factory.mktemp("long") / "long.h5"
    with SessionWriter(path, SessionFacts(title="", skin_name="", skin_toml="", epoch=EPOCH)) as writer:
        writer.add_stream("raw", StreamFacts("counts", units="1", channels=50, rate_hz=10, dtype="i4"))
        rows = np.arange(3000)
        writer.append("raw", rows, rows[:, None] * 100 + np.arange(50))
    return path


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(start=st.integers(-3100, 3100), stop=st.none() | st.integers(-3100, 3100))
def test_slices_equal_slices_of_the_whole(long: Path, start: int, stop: int | None) -> None:
    whole = np.arange(3000.0)[:, None] * 100 + np.arange(50)
    with open_session(long) as s:
        np.testing.assert_array_equal(s.streams["raw"].read(start, stop), whole[start:stop])


def test_blocks_cover_a_stream_in_bounded_pieces(long: Path) -> None:
    with open_session(long) as s:
        blocks = list(s.streams["raw"].blocks(max_bytes=100_000))
        assert len(blocks) > 5
        assert max(values.nbytes for _, _, values in blocks) <= 100_000
        whole = np.concatenate([values for _, _, values in blocks])
        np.testing.assert_array_equal(whole, s.streams["raw"].read())
        assert [b[0] for b in blocks[1:]] == [b[1] for b in blocks[:-1]]


def test_other_units_are_converted_as_declared(good: Path, tmp_path: Path) -> None:
    def declare(file: h5py.File) -> None:
        file["streams/force/force"].attrs["units"] = np.bytes_("g")

    with open_session(good) as a, open_session(changed(good, tmp_path, declare)) as b:
        newtons, grams = a.streams["force"].read(), b.streams["force"].read()
    assert b.streams["force"].unit == "N"
    np.testing.assert_allclose(grams, newtons * 9.80665e-3, rtol=1e-12)


def test_infinite_and_overflowing_numbers_are_missing(good: Path, tmp_path: Path) -> None:
    stored = np.array([[1.0], [np.inf], [-np.inf], [1e16], [1e308]] * 40)

    def put(file: h5py.File) -> None:
        replace(FORCE, data=stored)(file)
        file[FORCE].attrs["units"] = np.bytes_("kN")

    with open_session(changed(good, tmp_path, put)) as s:
        np.testing.assert_array_equal(s.streams["force"].read(0, 5)[:, 0], [1e3] + [np.nan] * 4)


def test_netcdf_readers_open_it(good: Path) -> None:
    with h5netcdf.File(good, "r") as file:
        voltage = file.groups["streams"].groups["eit"].variables["voltage"]
        assert voltage.dimensions == ("time", "channel")
        assert voltage.attrs["units"] in ("V", b"V")
        assert file.groups["presses"].variables["x"].dimensions == ("press",)


def test_checksum_is_that_of_the_library(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "f.h5", "w") as file:
        for size in (1, 2, 3, 255, 4096, 70_001):
            data = rng.integers(0, 256, size, dtype="u1")
            dataset = file.create_dataset(str(size), data=data, chunks=(size,), fletcher32=True)
            _, raw = dataset.id.read_direct_chunk((0,))
            assert checksum_holds(raw)
            spoilt = bytearray(raw)
            spoilt[size // 2] ^= 4
            assert not checksum_holds(bytes(spoilt))


# --- the writer refuses, and leaves nothing half-written -----------------------------------------


def interrupted(path: Path) -> None:
    with SessionWriter(path, SessionFacts(**options())) as writer:
        fill(writer, 100, 10)
        raise KeyboardInterrupt


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = make(tmp_path / "s.h5")
    before = file_hash(path)
    with pytest.raises(KeyboardInterrupt):
        interrupted(path)
    assert file_hash(path) == before
    assert os.listdir(tmp_path) == ["s.h5"]


def recorded(path: Path, rows: int, **changes: object) -> Path:
    about = {"simulated": False, "scene": None, "seed": None} | changes
    with SessionWriter(path, SessionFacts(**options(**about))) as writer:
        writer.add_stream("eit", StreamFacts("voltage", units="V", channels=3, rate_hz=100))
        writer.append("eit", *samples(rows)[:2])
    return path


@pytest.mark.parametrize(
    "changes",
    [{"simulated": True, "scene": "[scene]", "seed": 3}, {}, {"creator": "a converter import"}],
    ids=["simulated", "recorded", "imported"],
)
def test_a_recording_gives_way_to_nothing(tmp_path: Path, changes: dict[str, object]) -> None:
    path = recorded(tmp_path / "s.h5", 200)
    before = file_hash(path)
    with pytest.raises(SessionError, match=r"s\.h5: file: holds a recording, which would be lost; give another name"):
        recorded(path, 100, **changes)
    assert file_hash(path) == before


def test_an_import_can_be_made_again(tmp_path: Path) -> None:
    path = recorded(tmp_path / "s.h5", 200, creator="a converter import")
    before = file_hash(path)
    assert file_hash(recorded(path, 100, creator="a converter import")) != before


KILLED = """
import os, signal, sys
from datetime import datetime, UTC
from calib.session import SessionFacts, SessionWriter
about = {"title": "", "skin_name": "", "skin_toml": "", "epoch": datetime(2025, 1, 1, tzinfo=UTC)}
with SessionWriter(sys.argv[1], SessionFacts(**about)):
    if len(sys.argv) > 2:
        os.kill(os.getpid(), signal.SIGKILL)
    print("writes", flush=True)
    sys.stdin.readline()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs locks of files")
def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    assert subprocess.run([sys.executable, "-c", KILLED, str(path), "now"], timeout=100, check=False).returncode < 0
    (left,) = os.listdir(tmp_path)
    assert left.endswith(".tmp")
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "writes\n"
        (being_written,) = os.listdir(tmp_path)
        assert being_written != left
        bystanders = {".other.h5.0123456789ab.tmp", ".s.h5.mine.tmp"}
        for name in bystanders:
            (tmp_path / name).write_text("")
        make(path)
        assert {*os.listdir(tmp_path)} == {"s.h5", being_written, *bystanders}
        other.communicate("\n")
    assert {*os.listdir(tmp_path)} == {"s.h5", *bystanders}


FULL_DISK = """
import resource, signal, sys
from datetime import datetime, UTC
import numpy as np
from calib.session import SessionFacts, SessionWriter, StreamFacts
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
about = {"title": "", "skin_name": "", "skin_toml": "", "epoch": datetime(2025, 1, 1, tzinfo=UTC)}
rng = np.random.default_rng(0)
try:
    with SessionWriter(sys.argv[1], SessionFacts(**about)) as writer:
        for name in ("one", "other"):
            writer.add_stream(name, StreamFacts("force", units="N", channels=3, rate_hz=100))
            for start in range(0, 40_000, 500):
                writer.append(name, start + np.arange(500), rng.normal(size=(500, 3)))
except ValueError as error:
    sys.exit(f"said: {error}")
"""


@pytest.mark.parametrize(
    "error",
    [OSError(errno.EFBIG, "too large"), OSError("Error writing bytes to file. Detail: [errno 27] File too large")],
    ids=["system", "Arrow"],
)
@pytest.mark.parametrize("beside", [replacing, folder_beside])
def test_a_full_disk_names_the_output(beside: Any, error: OSError, tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    with (
        pytest.raises(SessionError, match=r"out.csv: file: cannot be written \(File too large\); free space"),
        beside(path),
    ):
        raise error
    with pytest.raises(PermissionError), beside(path):
        raise PermissionError(errno.EACCES, "of an input")
    assert not os.listdir(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="needs file size limits")
def test_a_full_disk_is_one_line_and_no_crash(tmp_path: Path) -> None:
    path = make(tmp_path / "s.h5")
    before = file_hash(path)
    command = [sys.executable, "-c", FULL_DISK, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("said: s.h5: file: cannot be written")
    assert len(done.stderr.splitlines()) == 1
    assert file_hash(path) == before
    assert os.listdir(tmp_path) == ["s.h5"]


def test_a_link_at_the_target_is_replaced_not_followed(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("mine")
    (tmp_path / "s.h5").symlink_to(other)
    make(tmp_path / "s.h5")
    assert other.read_text() == "mine"
    assert not (tmp_path / "s.h5").is_symlink()


REFUSED_WRITES: dict[str, tuple[Callable[[SessionWriter], object], str]] = {
    "units": (lambda w: w.add_stream("a", StreamFacts("force", units="g", channels=1, rate_hz=1)), "given in 'g'"),
    "mislabelled": (
        lambda w: w.add_stream("a", StreamFacts("force", units="Pa", channels=1, rate_hz=1)),
        "force is given in 'Pa'; convert it to N",
    ),
    "name": (
        lambda w: w.add_stream("../a", StreamFacts("force", units="N", channels=1, rate_hz=1)),
        "cannot be used",
    ),
    "coarse": (
        lambda w: w.add_stream("a", StreamFacts("force", units="N", channels=1, rate_hz=1, dtype="i2")),
        "give scale_factor",
    ),
    "back in time": (lambda w: w.append("eit", [5, 4], np.zeros((2, 3))), "at row 1"),
    "equal times": (lambda w: w.append("eit", [5, 5], np.zeros((2, 3))), "at row 1"),
    "float times": (lambda w: w.append("eit", [5.0, 6.0], np.zeros((2, 3))), "2 integers"),
    "mask": (lambda w: w.append("eit", [5], np.ma.masked_equal([[1.0, 2.0, 3.0]], 2)), "values.filled(numpy.nan)"),
    "shape": (lambda w: w.append("eit", [5, 6], np.zeros((2, 4))), "(2, 3)"),
    "unknown stream": (lambda w: w.append("eat", [5], np.zeros((1, 3))), "add_stream first"),
    "flags": (lambda w: w.append("eit", [5], np.zeros((1, 3)), status=[1 << 20]), "does not fit"),
    "text": (lambda w: w.set_truth({"a/b": (1.0, "N")}), "plain name"),
}


def attempted(path: Path, attempt: Callable[[SessionWriter], object]) -> None:
    with SessionWriter(path, SessionFacts(**options())) as writer:
        writer.add_stream("eit", StreamFacts("voltage", units="V", channels=3, rate_hz=100))
        attempt(writer)


@pytest.mark.parametrize("case", REFUSED_WRITES)
def test_the_writer_refuses(case: str, tmp_path: Path) -> None:
    attempt, words = REFUSED_WRITES[case]
    with pytest.raises(SessionError) as caught:
        attempted(tmp_path / "s.h5", attempt)
    assert words in str(caught.value)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"epoch": datetime(2025, 1, 1)}, "time zone"),
        ({"scene": None}, "does not say how"),
        ({"pattern": np.zeros((3, 3), int)}, "(M, 4)"),
        ({"pattern": -PATTERN}, "from 0"),
        ({"offset": [0.0]}, "one time per reading"),
        ({"pattern": None}, "give pattern"),
    ],
)
def test_the_writer_refuses_descriptions(changes: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=words.replace("(", r"\(").replace(")", r"\)")):
        SessionWriter(tmp_path / "s.h5", SessionFacts(**options(**changes)))


def test_a_press_table_must_be_sound() -> None:
    columns = {name: getattr(PRESSES, name) for name in PRESSES.__dataclass_fields__}
    for name, value, words in [
        ("x", np.array([0.1]), "unequal length"),
        ("y", np.array([0.1, np.nan]), "row 1"),
        ("tip_diameter", np.array([0.02, -0.01]), "tip_diameter of row 1 is -0.01 m; give 0, not known, or more"),
        ("t_hold0", np.array([0, 6]), "row 0"),
        ("pad", np.array([0.5, 1.0]), "integers"),
    ]:
        with pytest.raises(SessionError, match=words):
            PressTable(**{**columns, name: value})


# --- the reader refuses --------------------------------------------------------------------------


def changed(good: Path, folder: Path, change: Callable[[h5py.File], object]) -> Path:
    """A copy of a good file with something changed through h5py."""
    path = folder / "changed.h5"
    path.write_bytes(good.read_bytes())
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        change(file)
    return path


def refusal(path: Path) -> str:
    """The one line with which a file is refused."""
    with pytest.raises(SessionError) as caught:
        everything(path)
    line = str(caught.value)
    assert line.startswith(f"{path.name}: ")
    assert "\n" not in line
    assert len(line) < 1000
    return line


def other_bytes(kind: str) -> bytes:
    """What might be offered in place of a session."""
    if kind == "npz":
        stream = io.BytesIO()
        np.savez(stream, a=np.arange(3))
        return stream.getvalue()
    return {
        "empty": b"",
        "csv": b"t,force\n0,1.5\n1,1.25\n",
        "pickle": pickle.dumps({"a": 1}),
        "noise": bytes(range(256)) * 4,
        "netcdf3": b"CDF\x01" + bytes(100),
        "signature": b"\x89HDF\r\n\x1a\n",
    }[kind]


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("empty", "is empty"),
        ("csv", "jaxeit import csv"),
        ("pickle", "pickle"),
        ("npz", "NumPy or zip"),
        ("noise", "not an HDF5 file"),
        ("netcdf3", "classic netCDF"),
        ("signature", "truncated"),
    ],
)
def test_other_files_are_refused(kind: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    path.write_bytes(other_bytes(kind))
    assert words in refusal(path)


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "none.h5")
    assert "is a folder" in refusal(tmp_path)
    with pytest.raises(SessionError, match=r"cannot be read \(File name too long\); check"):
        open_session(tmp_path / ("x" * 300))


def test_half_a_file_is_refused(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    path.write_bytes(good.read_bytes()[:20_000])
    assert "truncated: 20,000 of" in refusal(path)


@pytest.mark.parametrize(("at", "byte", "words"), [(9, 4, "unusual HDF5 header"), (11, 1, "was never closed")])
def test_an_unusual_header_is_refused(at: int, byte: int, words: str, good: Path, tmp_path: Path) -> None:
    raw = bytearray(good.read_bytes())
    raw[at] = byte
    (tmp_path / "s.h5").write_bytes(raw)
    assert words in refusal(tmp_path / "s.h5")


def test_foreign_and_old_hdf5_is_refused(tmp_path: Path) -> None:
    for versions, words in [
        (("v110", "v110"), "not a session"),
        (("earliest", "v110"), "older HDF5"),
    ]:
        with h5py.File(tmp_path / "s.h5", "w", libver=versions) as file:
            file["data"] = np.arange(3)
        assert words in refusal(tmp_path / "s.h5")


TEXTS = [
    ('a = "b"\n[c]\n', "looks like TOML"),
    ("a,b\n1,2\n", "looks like CSV"),
    ("<!DOCTYPE html>\n<p>not found\n", "is a web page or XML"),
]


@pytest.mark.parametrize(("text", "said"), TEXTS)
def test_text_is_told_apart(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "s.h5").write_text(text)
    assert said in refusal(tmp_path / "s.h5")


def test_an_unfinished_recording_opens_and_says_so(good: Path, tmp_path: Path) -> None:
    path = changed(good, tmp_path, lambda f: f.attrs.modify("complete", np.uint8(0)))
    with open_session(path) as s:
        assert s.complete is False
        assert len(s.streams["eit"]) == 200


def test_what_is_unknown_is_ignored_and_later_versions_open(good: Path, tmp_path: Path) -> None:
    def add(file: h5py.File) -> None:
        file.create_group("mine")["link"] = h5py.ExternalLink("/etc/passwd", "/")
        file.attrs["mine"] = ["a", "list"]
        file.attrs["format_version"] = np.bytes_("1.7")

    path = changed(good, tmp_path, add)
    assert everything(path)[1:] == everything(good)[1:]


def replace(name: str, **how: object) -> Callable[[h5py.File], None]:
    """Put another dataset in the place of one."""

    def change(file: h5py.File) -> None:
        del file[name]
        filters = {"chunks": True, "compression": "gzip", "fletcher32": True}
        file.create_dataset(name, **{**filters, **how})
        for key, value in {"units": "N", "signal": "force"}.items():
            file[name].attrs[key] = np.bytes_(value)

    return change


def attribute(where: str, name: str, value: object) -> Callable[[h5py.File], None]:
    """Set an attribute, or delete it (None)."""

    def change(file: h5py.File) -> None:
        if value is None:
            del file[where].attrs[name]
        else:
            file[where].attrs[name] = value

    return change


def link(name: str, value: object) -> Callable[[h5py.File], None]:
    """Put a link in the place of an object."""

    def change(file: h5py.File) -> None:
        del file[name]
        file[name] = value

    return change


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((200, 1), "f4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (200, 1))
    del file["streams/force/force"]
    file.create_virtual_dataset("streams/force/force", layout)


def external(file: h5py.File) -> None:
    del file["streams/force/force"]
    storage = [("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    file.create_dataset("streams/force/force", (200, 1), "u1", external=storage)


def compound(file: h5py.File) -> None:
    replace("streams/force/force", shape=(200,), dtype=[("a", "f8"), ("b", "i4")])(file)


def odd_integer(file: h5py.File) -> None:
    """An integer of 12 significant bits in 16: another reader would see other numbers."""
    kind = h5t.STD_I16LE.copy()
    kind.set_precision(12)
    del file["streams/force/force"]
    space, plist = h5s.create_simple((200, 1)), h5p.create(h5p.DATASET_CREATE)
    h5d.create(file["streams/force"].id, b"force", kind, space, plist)


def many_streams(file: h5py.File) -> None:
    for i in range(5000):
        file[f"streams/x{i}"] = h5py.SoftLink("/")


def wide_root(file: h5py.File) -> None:
    for i in range(2000):
        file[f"x{i}"] = h5py.SoftLink("/")


def many_attributes(file: h5py.File) -> None:
    for i in range(400):
        file.attrs[f"x{i}"] = i


def repeated_time(file: h5py.File) -> None:
    file["streams/eit/time"][17] = file["streams/eit/time"][16]


def short_pattern(file: h5py.File) -> None:
    del file["device/eit_protocol/offset"]
    replace("device/eit_protocol/pattern", data=PATTERN[:2])(file)


def no_stream(file: h5py.File) -> None:
    del file["streams"]
    file.create_group("streams")


def two_variables(file: h5py.File) -> None:
    del file["streams/force"].attrs["signal"]
    file["streams/force/other"] = 1.0


FORCE = "streams/force/force"
PLAIN = {"chunks": None, "compression": None, "fletcher32": False}
REFUSED_FILES: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "version 2": (attribute("/", "format_version", np.bytes_("2.0")), "format version 2.0"),
    "other format": (attribute("/", "format", np.bytes_("skin-forcemap")), "'skin-forcemap'"),
    "no epoch": (attribute("/", "time_epoch_utc", None), "time_epoch_utc is missing"),
    "wrong epoch": (attribute("/", "time_epoch_utc", np.bytes_("noon")), "'noon'"),
    "no device": (lambda f: f.pop("device"), "/device: missing"),
    "no streams": (lambda f: f.pop("streams"), "/streams: missing"),
    "no time": (lambda f: f.pop("streams/eit/time"), "/streams/eit/time: missing"),
    "no variable": (lambda f: f.pop(FORCE), f"/{FORCE}: missing"),
    "no units": (attribute(FORCE, "units", None), "units is missing"),
    "unknown units": (attribute(FORCE, "units", np.bytes_("stone")), "use one of: 1, counts, V"),
    "other quantity": (attribute(FORCE, "units", np.bytes_("kPa")), "force in kPa is mislabelled"),
    "no rate": (attribute("streams/eit", "nominal_rate_hz", None), "nominal_rate_hz is missing"),
    "rate of NaN": (attribute("streams/eit", "nominal_rate_hz", np.nan), "not a finite number"),
    "repeated time": (repeated_time, "does not increase at row 17"),
    "time as float": (replace("streams/eit/time", data=np.arange(200.0)), "is float64 of rank 1"),
    "too few times": (replace("streams/eit/time", data=np.arange(20)), "beside 200 samples"),
    "wrong rank": (replace(FORCE, data=np.zeros((200, 1, 1))), "rank 3"),
    "pattern": (short_pattern, "has 3 channels, the pattern has 2 rows"),
    "pattern of pairs": (replace("device/eit_protocol/pattern", data=PATTERN * 0), "row 0 is no"),
    "presses": (replace("presses/x", data=np.zeros(3)), "unequal length"),
    "press of NaN": (replace("presses/x", data=np.full(2, np.nan)), "x of row 0 is not finite"),
    "text of variable length": (attribute("/", "title", "x"), "variable-length text"),
    "attribute of references": (
        attribute("/", "title", h5py.Reference()),
        "is an object reference",
    ),
    "soft link": (link("streams/force", h5py.SoftLink("/streams/eit")), "a soft link"),
    "external link": (link("streams/force", h5py.ExternalLink("a", "/b")), "an external link"),
    "link cycle": (link("streams/force", h5py.SoftLink("/streams/force")), "a soft link"),
    "virtual dataset": (virtual, "is a virtual dataset"),
    "external storage": (external, "has external storage"),
    "objects": (replace(FORCE, shape=(9,), dtype=h5py.vlen_dtype("f4"), **PLAIN), "of variable"),
    "references": (replace(FORCE, shape=(9,), dtype=h5py.ref_dtype, **PLAIN), "object reference"),
    "compound": (compound, "a compound type"),
    "odd integer": (odd_integer, "of an unusual type"),
    "unknown filter": (replace(FORCE, data=np.zeros((200, 1)), compression="lzf"), "'lzf'"),
    "no checksum": (replace(FORCE, data=np.zeros((200, 1)), fletcher32=False), "without checksum"),
    "claims 2.4 TB": (replace(FORCE, shape=(300_000_000_000, 1), dtype="f8"), "claims 2,400,000"),
    "chunks of 32 MB": (replace(FORCE, shape=(1 << 22, 1), dtype="f8", chunks=(1 << 22, 1)), "c"),
    "holes": (replace(FORCE, shape=(200, 1), dtype="f4"), "1 of 1 chunks missing"),
    "many streams": (many_streams, "has 5,002 members"),
    "wide root": (wide_root, "members, the limit is 1,024"),
    "many attributes": (many_attributes, "attributes, the limit is 256"),
    "large attribute": (attribute("/", "title", np.bytes_("x" * 5_000_000)), "5,000,000 bytes"),
    "not UTF-8": (attribute("/", "title", np.bytes_(b"\xff\xfe")), "is not UTF-8"),
    "stream as numbers": (link("streams/force", np.zeros(3)), "is a dataset where a group belongs"),
    "numbers as stream": (lambda f: (f.pop(FORCE), f.create_group(FORCE)), "is a group where a dataset"),
    "a type alone": (link("streams/force", np.dtype("f8")), "is neither group nor dataset"),
    "no stream at all": (no_stream, "holds no stream"),
    "no word on the variable": (two_variables, "does not say which variable it holds"),
    "no shape": (link(FORCE, h5py.Empty("f4")), "has no shape or too many dimensions"),
    "chunks of 4 bytes": (replace(FORCE, shape=(1 << 21, 1), dtype="f4", chunks=(1, 1)), "has 2,097,152 chunks"),
    "table of two columns": (replace("presses/x", data=np.zeros((2, 2))), "of shape (2, 2); write shape (rows)"),
    "truth in words": (replace("truth/site", data=np.full(2, b"x")), "/truth/site: holds |S1, not numbers"),
    "endless texts": (replace("presses/reason", data=np.full(2, b"x" * 100_000)), "holds texts of 100,000 bytes"),
}


@pytest.mark.parametrize("case", REFUSED_FILES)
def test_unsound_files_are_refused(case: str, good: Path, tmp_path: Path) -> None:
    change, words = REFUSED_FILES[case]
    assert words in refusal(changed(good, tmp_path, change))


def put_chunk(file: h5py.File, raw: bytes, mask: int = 0) -> None:
    """Write stored bytes as the only chunk of the force stream, checksum filter last."""
    replace(FORCE, shape=(200, 1), dtype="f4", chunks=(200, 1))(file)
    file[FORCE].id.write_direct_chunk((0, 0), raw, mask)


def with_sum(raw: bytes) -> bytes:
    """Stored bytes with the checksum that belongs to them."""
    words = np.frombuffer(raw + b"\0" * (len(raw) % 2), ">u2").astype(object)
    s1, s2 = int(words.sum()) % 65535, int((words * np.arange(len(words), 0, -1)).sum()) % 65535
    return raw + (s2 << 16 | s1).to_bytes(4, "little")


def test_a_gzip_bomb_is_refused_before_it_unfolds(good: Path, tmp_path: Path) -> None:
    bomb = with_sum(zlib.compress(bytes(1 << 22), 9))
    path = changed(good, tmp_path, lambda f: put_chunk(f, bomb))
    tracemalloc.start()
    try:
        assert "does not inflate to 800 bytes" in refusal(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 21
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("raw", "mask", "words"),
    [
        (with_sum(zlib.compress(bytes(400))), 0, "does not inflate"),
        (with_sum(b"not deflate"), 0, "does not inflate"),
        (zlib.compress(bytes(800)) + b"\0\0\0\1", 0, "checksum"),
        (bytes(800), 0b11, "checksum"),
        (with_sum(bytes(400)), 0b01, "wrong size"),
        (bytes(80_000), 0, "too long"),
    ],
)
def test_false_chunks_are_refused(raw: bytes, mask: int, words: str, good: Path, tmp_path: Path) -> None:
    assert words in refusal(changed(good, tmp_path, lambda f: put_chunk(f, raw, mask)))


def damaged(raw: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, flip bits, overwrite with noise, or overwrite with zeros."""
    data, at = bytearray(raw), int(rng.integers(len(raw)))
    kind = rng.integers(4)
    if kind == 0:
        return bytes(data[:at])
    if kind == 1:
        for place in rng.integers(len(raw), size=rng.integers(1, 4)):
            data[place] ^= 1 << int(rng.integers(8))
    else:
        size = min(int(rng.integers(1, 400)), len(raw) - at)
        data[at : at + size] = rng.bytes(size) if kind == 2 else bytes(size)
    return bytes(data)


def test_damaged_files_are_refused_or_unharmed(good: Path, tmp_path: Path) -> None:
    raw, path, rng = good.read_bytes(), tmp_path / "s.h5", np.random.default_rng(20)
    whole, refused = everything(good), 0
    for _ in range(200):
        path.write_bytes(damaged(raw, rng))
        try:
            assert everything(path) == whole
        except SessionError:
            refused += 1
    assert refused > 120


# --- result files --------------------------------------------------------------------------------

ARRAYS = {
    "pads/0/covariance": (np.eye(3), "N2", "covariance of the curve"),
    "pads/1/covariance": (2.0 * np.eye(3), "N2", ""),
    "names": (np.array(["a", "é"]), "", "pads"),
    "valid": (np.array([[True, False]]), "1", ""),
    "gain": (3.5, "N/Pa", ""),
    "none": (np.zeros((0, 4)), "N", ""),
    "count": (np.arange(5, dtype="i4"), "1", ""),
}


def test_results_come_back(tmp_path: Path) -> None:
    for name in ("a.h5", "b.h5"):
        attrs = {"skin": "bench", "rows": 3, "rmse": 0.25}
        write_archive(tmp_path / name, "skin-calibration", attrs, ARRAYS)
    assert file_hash(tmp_path / "a.h5") == file_hash(tmp_path / "b.h5")
    archive = read_archive(tmp_path / "a.h5", "skin-calibration")
    assert (archive.attrs["skin"], archive.attrs["rows"], archive.attrs["rmse"]) == (
        "bench",
        3,
        0.25,
    )
    assert set(archive.arrays) == set(ARRAYS)
    for name, (values, units, long_name) in ARRAYS.items():
        found = archive.arrays[name]
        assert found.dtype == np.asarray(values).dtype
        np.testing.assert_array_equal(found, values)
        assert (archive.units[name], archive.long_names[name]) == (units, long_name)


def test_bytes_do_not_depend_on_who_else_holds_an_array(tmp_path, monkeypatch):
    """A profiler, such as that of a Dask worker, keeps the frames of a thread, and with them what they name."""
    arrays = {"k": (np.arange(3), "1", "")} | {f"x{n}": (np.ones(3), "1", "") for n in range(5)}
    write_archive(tmp_path / "a.h5", "x", {}, arrays, dict.fromkeys(arrays, ("k",)))
    held, make = [], archive.make_array

    def hold(*what):
        held.append(make(*what))
        return held[-1]

    monkeypatch.setattr(archive, "make_array", hold)
    write_archive(tmp_path / "b.h5", "x", {}, arrays, dict.fromkeys(arrays, ("k",)))
    assert len(held) == 6
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_rows_may_be_written_and_read_in_pieces(tmp_path: Path) -> None:
    rows = np.random.default_rng(1).normal(size=(700, 6, 50))
    with ArchiveWriter(tmp_path / "f.h5", "skin-forcemap", {}) as writer:
        writer.add_rows("force", (6, 50), "N")
        for start in range(0, 700, 13):
            writer.append("force", rows[start : start + 13])
    with open_archive(tmp_path / "f.h5", "skin-forcemap") as reader:
        force = reader.arrays["force"]
        assert (force.shape, force.units) == ((700, 6, 50), "N")
        np.testing.assert_array_equal(force.read(100, 555), rows[100:555])


def test_what_does_not_fit_into_memory_is_read_in_slices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_archive(tmp_path / "a.h5", "x", {}, {"a": (np.zeros(100), "1", "")})
    monkeypatch.setenv("JAXEIT_BUDGET", str(799 / (2 << 30)))
    with pytest.raises(SessionError, match=r"file: 800 bytes at once, the limit is 799; read it in slices with open_a"):
        read_archive(tmp_path / "a.h5", "x")


@pytest.mark.parametrize("name", ["../a", "/a", "a//b", "dim_3", "a/b/c/d/e", "é", ""])
def test_names_that_lead_elsewhere_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="cannot be used as a name"):
        write_archive(tmp_path / "a.h5", "x", {}, {name: (1.0, "1", "")})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("values", [np.array([None]), np.array([1j]), np.array([b"x"])])
def test_objects_are_refused(values: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="give numbers or texts"):
        write_archive(tmp_path / "a.h5", "x", {}, {"a": (values, "1", "")})


@pytest.mark.parametrize(
    ("knots", "tick", "words"), [(2, 1e-6, "knots of unequal number"), (3, np.nan, "a number is not finite")]
)
def test_a_clock_must_be_sound(knots: int, tick: float, words: str) -> None:
    with pytest.raises(SessionError, match=words):
        ClockTable(np.arange(3), np.arange(knots), tick, 0.0, 0.0, 0.0, True, "")


@pytest.mark.parametrize(
    ("attrs", "put", "words"),
    [
        ({}, lambda w: w.append("b", [1.0]), "b: was not declared; call add_rows first"),
        ({}, lambda w: w.add_rows("b", (), "1", dtype=bool), "b: bool rows; use dtype u1"),
        ({}, lambda w: (w.add_rows("b", (2,), "1"), w.append("b", [1.0])), r"b: rows of shape \(1,\); give"),
        ({"a": None}, lambda w: None, "a: is a NoneType; give a text or a number"),
        ({"a": "x\0"}, lambda w: None, "a: is a text that cannot be stored"),
        ({"complete": True}, lambda w: None, r"attributes \['complete'\] are reserved; use other names"),
    ],
)
def test_what_an_archive_does_not_take_is_refused(attrs: dict, put: Callable, words: str, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=words), ArchiveWriter(tmp_path / "a.h5", "x", attrs) as writer:
        put(writer)
    assert os.listdir(tmp_path) == []


def test_writers_are_to_be_opened(tmp_path: Path) -> None:
    writers = ArchiveWriter(tmp_path / "a.h5", "x", {}), SessionWriter(tmp_path / "s.h5", SessionFacts(**options()))
    puts = (
        lambda w: w.add("a", 1.0, "1"),
        lambda w: w.add_stream("a", StreamFacts("force", units="N", channels=1, rate_hz=1)),
    )
    for writer, put in zip(writers, puts, strict=True):
        with pytest.raises(SessionError, match="is not open; use it as `with"):
            put(writer)


def deep(file: h5py.File) -> None:
    file["/".join("a" * 50) + "/x"] = 1.0


def cycle(file: h5py.File) -> None:
    file["pads/again"] = file["/"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (attribute("/", "format", np.bytes_("other")), "'other', not"),
        (attribute("/", "complete", None), "not complete"),
        (attribute("/", "format_version", np.bytes_("3.1")), "format version 3.1"),
        (deep, "too deeply nested"),
        (cycle, "too deeply nested"),
        (link("gain", h5py.SoftLink("/none")), "a soft link"),
    ],
)
def test_unsound_results_are_refused(change: Callable, words: str, tmp_path: Path) -> None:
    write_archive(tmp_path / "good.h5", "skin-calibration", {}, ARRAYS)
    path = changed(tmp_path / "good.h5", tmp_path, change)
    with pytest.raises(SessionError, match=words):
        read_archive(path, "skin-calibration")


def test_a_session_is_no_result(good: Path) -> None:
    with pytest.raises(SessionError, match="'skin-session', not 'skin-calibration'"):
        read_archive(good, "skin-calibration")
