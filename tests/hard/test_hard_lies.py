"""Files that are well formed and false: each is refused in one line that names the place, before it costs anything.

A lie is a change to a good file. Those that would hang or exhaust the memory are read in a process of their own, with
little of both.
"""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from h5py import h5d, h5p, h5s, h5t

import jaxeit as je
from calib.calibration.calibration import load_calibration
from calib.fitting.logs.blend import fit_blend
from calib.fitting.results import FitError
from calib.presses.corrections import window_means
from calib.presses.streams import ArrayStream, PressError, recording_end
from calib.session import SessionError, open_session
from jaxeit.toml import MAX_DEPTH, MAX_KEY_PARTS
from tests.fuzzing import calibration
from tests.session.test_session import FORCE, attribute, changed, make, replace

ROOT = Path(__file__).parents[2]
SECONDS = 60  # of a hang; refused in milliseconds, once Python and its libraries have been imported
MEMORY = 2 << 30  # bytes of address space beyond what the libraries take


def linked(kind, target="other.h5"):
    """A force stream whose signal is a path through a link."""

    def change(file):
        force = file["streams/force"]
        force["evil"] = h5py.SoftLink("/streams/eit") if kind == "soft" else h5py.ExternalLink(target, "/streams/force")
        force.attrs["signal"] = np.bytes_("evil/voltage" if kind == "soft" else "evil/force")

    return change


def named(text):
    return attribute("streams/force", "signal", np.bytes_(text))


def endless(file):
    """A virtual dataset without end, whose shape is that of a file that is a pipe."""
    plist, space = h5p.create(h5p.DATASET_CREATE), h5s.create_simple((10,), (h5s.UNLIMITED,))
    source = h5s.create_simple((10,), (h5s.UNLIMITED,))
    for part in (space, source):
        part.select_hyperslab((0,), (1,), None, (h5s.UNLIMITED,))
    plist.set_virtual(space, b"pipe", b"x", source)
    del file[FORCE]
    h5d.create(file["streams/force"].id, b"force", h5t.NATIVE_DOUBLE, space, plist)


def zeros(rows):
    """Times and forces that claim `rows` rows of zeros, in few stored bytes."""

    def change(file):
        for name, dtype in (("time", "i8"), ("force", "f4")):
            shape = (rows,) if name == "time" else (rows, 1)
            replace(f"streams/force/{name}", shape=shape, dtype=dtype, chunks=(1 << 20, 1)[: len(shape)])(file)
            chunk = np.zeros((1 << 20, 1)[: len(shape)], dtype)
            for start in range(0, rows, 1 << 20):
                file[f"streams/force/{name}"][start : start + (1 << 20)] = chunk[: rows - start]
        del file["streams/force/status"], file["streams/force/seq"], file["streams/force/time_host"]

    return change


SESSIONS = {
    "the signal is a path through an external link": (
        linked("external"),
        "names the member 'evil/force', which is a path",
    ),
    "the signal is a path through a soft link": (linked("soft"), "names the member 'evil/voltage', which is a path"),
    "the signal is a path through a link to a pipe": (linked("external", "pipe"), "which is a path"),
    "the signal is a path from the root": (named("/streams/eit/voltage"), "names the member '/streams/eit/voltage'"),
    "the signal is the group itself": (named("."), "names the member '.', which is a path"),
    "a virtual dataset whose shape is in a pipe": (endless, f"/{FORCE}: is a virtual dataset"),
    "an amplitude below zero": (attribute("device/eit_protocol", "current", -1e-3), "current -0.001 A at 10000.0 Hz"),
    "a frequency below zero": (attribute("device/eit_protocol", "frequency", -1.0), "at -1.0 Hz cannot be"),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return make(tmp_path_factory.mktemp("good") / "good.h5")


def process(code, folder, *arguments):
    """A process with little memory and time: its status, and what it said."""
    limited = (
        "import json, resource, sys; from pathlib import Path\n"
        "import calib.cli, calib.session, jaxeit as je; from calib.calibration import Recipe\n"
        "from calib.record.journal.file import JournalReader\n"
        "from calib.session import file_hash, open_session\n"
        "size = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()\n"
        f"resource.setrlimit(resource.RLIMIT_AS, (size + {MEMORY}, resource.RLIM_INFINITY))\n"
        "def said(read, *given):\n"
        "    try: read(*given)\n"
        "    except (ValueError, OSError) as error: return str(error)\n"
    )
    command = [sys.executable, "-c", limited + code, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS, check=False
    )
    return done.returncode, done.stdout + done.stderr


def all_said(read, names, folder):
    """What each file is refused with, None if it is read; all in one process."""
    status, text = process(
        f"{read}\nprint(json.dumps({{name: said(read, name) for name in sys.argv[1:]}}))", folder, *names
    )
    assert status == 0, text
    return json.loads(text.splitlines()[-1])


READ = """
def read(path):
    with calib.session.open_session(path) as found:
        for stream in found.streams.values():
            stream.time, stream.read()
"""


@pytest.fixture(scope="module")
def answers(good, tmp_path_factory):
    """What the session of each lie is refused with, beside another session and a pipe."""
    folder = tmp_path_factory.mktemp("lies")
    make(folder / "other.h5")
    os.mkfifo(folder / "pipe")
    for number, (change, _) in enumerate(SESSIONS.values()):
        changed(good, folder, change).rename(folder / f"{number}.h5")
    found = all_said(READ, [f"{number}.h5" for number in range(len(SESSIONS))], folder)
    return dict(zip(SESSIONS, found.values(), strict=True))


@pytest.mark.parametrize("lie", SESSIONS)
def test_sessions_that_lie_are_refused(lie, answers):
    said = SESSIONS[lie][1]
    assert said in str(answers[lie])
    assert "\n" not in answers[lie]


def test_times_that_stand_still_are_refused_after_their_first_block(good, tmp_path):
    """Few stored bytes that stand for 64 MB of zeros: refused after the first block."""
    path = changed(good, tmp_path, zeros(8 << 20))
    assert path.stat().st_size < 1 << 20
    with open_session(path) as session, pytest.raises(SessionError, match="does not increase at row 1 "):
        _ = session.streams["force"].time


def test_what_is_beyond_the_budget_is_not_allocated(good, tmp_path, monkeypatch):
    path = make(tmp_path / "s.h5", 400)
    with open_session(path) as session:
        monkeypatch.setattr("calib.session.hdf5.chunks.GuardedArray._gather", None)  # nothing is read
        monkeypatch.setenv("JAXEIT_BUDGET", "1e-6")
        with pytest.raises(SessionError) as caught:
            _ = session.streams["eit"].time
    said = "s.h5: /streams/eit/time: 3,200 bytes at once, the limit is 2,147; use less of it, "
    assert str(caught.value).startswith(said)
    assert str(caught.value).endswith("or raise all limits with JAXEIT_BUDGET=4")


READERS = "open_session, file_hash, je.load_skin, Recipe.load, je.load_reconstructor, JournalReader"


def test_only_regular_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    os.symlink("/dev/zero", tmp_path / "device")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
        kinds = ("pipe", "folder", "device", "socket")
        code = f"print(json.dumps([[said(read, kind) for read in ({READERS})] for kind in {kinds}]))"
        status, text = process(code, tmp_path)
    assert status == 0, text
    for kind, lines in zip(kinds, json.loads(text.splitlines()[-1]), strict=True):
        assert all(f"is a {kind}" in line or "no such file" in line for line in lines), lines
        assert sum(f"is a {kind}" in line for line in lines) == len(lines) - 1  # a skin may be a name


# --- skins and other texts --------------------------------------------------------------------------------------------

TESTBED = je.load_skin("testbed").toml


def edited(*pairs):
    text = TESTBED
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new, 1)
    return text


CHAIN = "a" + ".a" * 100_000
TEXTS = {
    "a key of 100,000 parts": (f"{CHAIN} = 1", f"a key of more than {MAX_KEY_PARTS} parts"),
    "a table of 100,000 parts": (f"x = 1\n[{CHAIN}]", "a key of more than 16 parts (at line 2)"),
    "quoted parts": ('"a"' + " . 'a'" * 50_000 + " = 1", "a key of more than 16 parts"),
    "a key behind a text that ends in four quotes": ('x = {s = """a"""", ' + CHAIN + " = 1}", "more than 16 parts"),
    "20,000 arrays in each other": ("a = " + "[" * 20_000, "nested too deeply"),
    "20,000 tables in each other": ("a = " + "{a = " * 20_000, "nested too deeply"),
    "texts without end": ('a = "' + '\\"' * 100_000, "not valid TOML: Unterminated string"),
    "2 MB": ("#" * (2 << 20), "2,097,152 bytes of text, the limit is 1,048,576"),
    "10^12 electrodes": (edited(("columns = 5", "columns = 1000000"), ("rows = 5", "rows = 1000000")),
                         "1,000,000,000,000 electrodes, the limit is 1,024"),
    "2,000 electrodes": (edited(("columns = 5", "columns = 50"), ("rows = 5", "rows = 40")), "2,000 electrodes, the"),
    "a number of 5,000 digits": ("a = " + "9" * 5000, "not valid TOML: Exceeds the limit"),
}  # fmt: skip


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """What the skin of each text is refused with."""
    folder = tmp_path_factory.mktemp("texts")
    for number, (text, _) in enumerate(TEXTS.values()):
        (folder / f"{number}.toml").write_text(text)
    found = all_said("read = je.load_skin", [f"{number}.toml" for number in range(len(TEXTS))], folder)
    return dict(zip(TEXTS, found.values(), strict=True))


@pytest.mark.parametrize("lie", TEXTS)
def test_texts_that_would_not_end_are_refused(lie, lines):
    assert TEXTS[lie][1] in str(lines[lie])
    assert "\n" not in lines[lie]
    assert len(lines[lie]) < 400


def test_honest_texts_are_far_from_the_limits():
    """A polygon of 3,000 corners, 1,000 readings, and marks in texts and comments."""
    angle = np.linspace(0, 2 * np.pi, 3000, endpoint=False)
    corners = (0.1 + 0.0999 * np.stack([np.cos(angle), np.sin(angle)], 1)).round(6).tolist()
    rows = je.skin.adjacent(25).tolist() * 2
    dots = "a.b" * 40
    text = edited(
        ('shape = "rectangle"', 'shape = "polygon"'),
        ("size = [0.2, 0.2]", f"vertices = {corners}"),
        ('pattern = "adjacent"', f"rows = {rows[:1000]}"),
        ("pitch = 0.04", "pitch = 0.02"),
        ("origin = [0.02, 0.02]", "origin = [0.06, 0.06]"),
        ('name = "testbed"', f'name = "{dots} [[[[" # {dots}'),
    )
    skin = je.skin.parse_skin(text[: text.index("[[pads]]")])
    assert (len(skin.domain.corner_points), skin.protocol.readings) == (3000, 1000)
    assert MAX_DEPTH >= 8


def test_limits_are_raised_by_one_variable(monkeypatch):
    wide = edited(
        ("columns = 5", "columns = 50"), ("rows = 5", "rows = 40"), ("size = [0.2, 0.2]", "size = [2.0, 1.6]")
    )
    wide = wide[: wide.index("[[pads]]")]
    with pytest.raises(je.toml.TomlError, match=r"raise all limits with JAXEIT_BUDGET=4$"):
        je.skin.parse_skin(wide)
    monkeypatch.setenv("JAXEIT_BUDGET", "4")
    assert len(je.skin.parse_skin(wide).electrodes) == 2000
    for wrong in ("much", "0", "-1", "inf", "nan"):
        monkeypatch.setenv("JAXEIT_BUDGET", wrong)
        with pytest.raises(ValueError, match=f"JAXEIT_BUDGET is '{wrong}'; give the factor"):
            je.skin.parse_skin(wide)


@pytest.mark.parametrize("level", ["draft", "standard"])
def test_nodes_are_foretold(skin, level):
    fidelity = getattr(je.Fidelity, level)()
    nodes = len(je.model.make_mesh(je.Scene(skin), fidelity).nodes)
    assert je.model.expected_mesh_nodes(skin, fidelity) == pytest.approx(nodes, rel=0.2)


MESHES = {
    "an edge of a tenth of a millimetre": (lambda: je.Fidelity(edge_length=2e-4), TESTBED, "mesh nodes, the limit"),
    "a strip of 20 m by a micrometre": (
        je.Fidelity.standard,
        edited(("size = [0.2, 0.2]", "size = [20, 1e-6]"), ("columns = 5", "columns = 25"), ("rows = 5", "rows = 1"),
               ("pitch = 0.04", "pitch = 0.5"), ("origin = [0.02, 0.02]", "origin = [1, 5e-7]"),
               ("radius = 0.003", "radius = 1e-7")),
        "mesh nodes, the limit",
    ),
}  # fmt: skip


@pytest.mark.parametrize("lie", MESHES)
def test_meshes_beyond_memory_are_refused_before_they_are_made(lie):
    fidelity, text, said = MESHES[lie]
    skin = je.skin.parse_skin(text[: text.index("[[pads]]")])
    with pytest.raises(ValueError, match=said):
        je.discretise(je.Scene(skin), fidelity())


def test_images_beyond_memory_are_refused_before_they_are_made(model):
    with pytest.raises(je.model.BasisError, match=r"4,000,000 coefficients of an image, the limit is 100,000"):
        je.Pixels(2000).on(model)


def test_logs_of_many_channels_are_refused_before_they_are_multiplied():
    with pytest.raises(FitError, match=r"^fit_blend: 280 channels to blend, the limit is 128; "):
        fit_blend(np.zeros((600, 280)), np.ones(600))


# --- calibrations and reconstructors ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    calibration(folder)
    return folder / "good.h5"


def times(name, factor):
    """An array times a factor, in its own type and layout."""

    def change(file):
        file[name][...] = np.asarray(file[name][...] * factor, file[name].dtype)

    return change


def lopsided(file):
    file["pads/covariance"][:, 0, 1] = 1.0


def as_half(name):
    return lambda file: replace(name, data=file[name][...].astype(np.float16))(file)


CALIBRATIONS = {
    "areas below zero": (times("image/areas", -1), r"image/areas: holds -0\.01; it must be zero or more"),
    "a current below zero": (times("image/current", -1), r"image/current: holds -0\.001; it must be above zero"),
    "noise below zero": (times("image/weight", -1), "image/weight: is not the inverse of a variance"),
    "variances below zero": (times("image/variance", -1), r"image/variance: holds -1; it must be zero or more"),
    "a factor of half precision": (as_half("image/factor"), "image/factor: is of type float16"),
    "a curve of half precision": (as_half("pads/parameters"), "pads/parameters is float16 of shape"),
    "covariances below zero": (times("pads/covariance", -1), "pads/covariance is no covariance"),
    "covariances that are not symmetric": (lopsided, "pads/covariance is no covariance"),
    "shares of pads below zero": (times("image/masks", -1), "image/masks holds -1, below zero"),
    "a range of pressure turned round": (times("pads/pressure_range", -1), "pads/pressure_range ends below its start"),
    "a scatter below zero": (times("pads/scale", -1), "pads/scale holds -1, below zero"),
}


@pytest.mark.parametrize("lie", CALIBRATIONS)
def test_calibrations_that_lie_are_refused_when_they_are_opened(lie, calibrated, tmp_path):
    change, said = CALIBRATIONS[lie]
    with pytest.raises(SessionError, match=rf"^changed\.h5: .*{said}.*; calibrate again$"):
        load_calibration(changed(calibrated, tmp_path, change))


@pytest.mark.parametrize(
    ("matrix", "is_one"),
    [
        (np.eye(3), True),
        (np.zeros((3, 3)), True),
        (np.ones((3, 3)), True),
        (np.stack([np.eye(2), [[1.0, 0.9], [0.9, 1.0]]]), True),
        (np.float32([[1e-8, 1e-4], [1e-4, 1.0]]), True),
        (-np.eye(3), False),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), False),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), False),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), False),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), False),
    ],
)
def test_what_is_a_covariance(matrix, is_one):
    assert je.linalg.is_covariance(matrix) is is_one


# --- numbers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e308, 1e300, 2e18, -1e200])
def test_values_that_nothing_measures_are_missing_and_overflow_nowhere(size, good, tmp_path):
    """Warnings are errors here: squares and sums of such values would overflow."""
    values = np.full((200, 1), 2.5)
    values[::2] = size
    with open_session(changed(good, tmp_path, replace(FORCE, data=values))) as session:
        force = session.streams["force"].read()
    assert np.isnan(force[::2]).all()
    means = window_means(force, np.array([[0, 100], [100, 200]]))
    np.testing.assert_allclose(means.mean, 2.5)
    assert np.float32(force[1::2]).sum() == 250


def test_streams_without_samples_are_named():
    full, empty = (ArrayStream(name, np.arange(n), np.zeros((n, 2))) for name, n in (("force", 3), ("eit", 0)))
    assert recording_end([full]) == 3
    for streams, said in (([full, empty], "^/streams/eit: no samples"), ([], "^/streams: no samples")):
        with pytest.raises(PressError, match=f"{said}, so that no press can be cut out; record again$"):
            recording_end(streams)


# --- the command line -------------------------------------------------------------------------------------------------

COMMAND = "import sys; from calib.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.parametrize("words", [["--help"], ["check", "{}"]], ids=["help", "check"])
def test_a_reader_that_leaves_ends_a_command_quietly(words, good):
    """As `jaxeit check FILE | head -1` does: here the reader has left before anything is written."""
    command = [sys.executable, "-c", COMMAND, *(word.format(good) for word in words)]
    reading, writing = os.pipe()
    os.close(reading)
    try:
        buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
        done = subprocess.run(
            command, stdout=writing, stderr=subprocess.PIPE, text=True, timeout=SECONDS, check=False, env=buffered
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize("error", ["MemoryError()", "RuntimeError('RESOURCE_EXHAUSTED: Out of memory')"])
def test_too_little_memory_is_one_line(error):
    code = (
        "import sys, calib.cli.commands.skins.doctor_command as command\n"
        f"def run(args): raise {error}\n"
        "command.run = run\n"
        "from calib.cli import main; sys.exit(main(['doctor']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=SECONDS, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("jaxeit: this machine has too little memory for it; use less data")
    assert len(done.stderr.splitlines()) == 1


def test_long_commands_say_first_what_they_compute(capsys):
    from calib.cli.terminal import announce_model  # noqa: PLC0415

    announce_model(je.load_skin("testbed"), je.Fidelity.draft())
    assert capsys.readouterr().err == ""
    announce_model(je.load_skin("testbed"), je.Fidelity.reference())
    said = capsys.readouterr().err
    assert said.startswith("jaxeit: testbed: 25 electrodes, 550 readings, about ")
    assert len(said.splitlines()) == 1


def test_the_lies_are_told_in_the_table_of_hard_cases(hard):
    kinds = {"sessions": SESSIONS, "texts": TEXTS, "meshes": MESHES, "calibrations": CALIBRATIONS}
    told = json.dumps({kind: len(lies) for kind, lies in kinds.items()})
    assert sum(map(len, kinds.values())) >= 30, told
    for kind, lies in kinds.items():
        hard(f"lies: {kind}", "; ".join(sorted(lies)), beyond="one line that names the place, the size and the limit")
