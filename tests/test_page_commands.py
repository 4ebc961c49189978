"""The commands of the pages run as they are printed, on recordings of the kind that each page speaks of.

Where a page names a device (``tcp://HOST:PORT``, ``serial:///dev/ttyACM0``) or a number of frames that takes hours, the
test gives another one.
"""

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.io import savemat

import calib
import jaxeit as je
from calib.cli import main
from calib.record.device import SimulatedDevice, frame_packets, recording_packets
from calib.record.plan import STREAM_KINDS
from tests.live.test_bridges import FakeRos
from tests.record.test_recorder import both, journal
from tests.tanks.instrument_files import goe_get
from tests.tanks.rods import tank_with_rod
from tests.tanks.tank_files import write_csv, write_ktc
from tests.test_docs import blocks, served, write_files
from tests.test_programs import write_log

ROOT = Path(__file__).parents[1]
SESSIONS = ROOT / "data" / "sessions"
SHORT = ["--port", "0", "--seconds", "20"]
"""What lets the live show of a test end."""


def commands(page):
    """The commands in the blocks of a page, without what explains them; those with an ellipsis are left out."""
    for language, _, text in blocks(ROOT / "docs" / page):
        for line in re.sub(r"\\\n *", "", text).splitlines() if not language else ():
            words = re.split(r"(?<=\S) {3,}(?=\S)| +#", line)[0]
            if words.startswith("jaxeit ") and "..." not in words:
                yield words


def do(line, *more, **given):
    """Run a command, with words of its own in place of some."""
    words = shlex.split(line)[1:]
    assert main([*(given.get(word, word) for word in words), *more]) == 0, line


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A folder with the bundled recordings and a calibration of one."""
    folder = tmp_path_factory.mktemp("pages")
    shutil.copy(SESSIONS / "testbed_grid.h5", folder / "session.h5")
    shutil.copy(SESSIONS / "testbed_presses.h5", folder / "use.h5")
    words = ["calibrate", str(folder / "session.h5"), "-o", str(folder / "calibration.h5"), "--fidelity", "draft"]
    assert main(words) == 0
    return folder


@pytest.fixture
def folder(calibrated, tmp_path, monkeypatch):
    """The same files in a folder of the test's own."""
    for path in calibrated.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_table(name, header, rows=200):
    """A table of text with a clock in its first column."""
    values = np.random.default_rng(0).normal(1, 0.1, (rows, len(re.findall(r'"[^"]*"|[^,]+', header))))
    values[:, 0] = np.arange(rows)
    np.savetxt(name, values, "%.6g", ",", header=header, comments="")


def write_bag(path):
    """A bag of ROS 2 with a force and a sensor."""
    rosbag2, stores = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    kinds = store.types
    zero = kinds["geometry_msgs/msg/Vector3"](0.0, 0.0, 1.0)
    stamp = kinds["builtin_interfaces/msg/Time"](0, 0)
    header = kinds["std_msgs/msg/Header"](stamp, "tool")
    layout = kinds["std_msgs/msg/MultiArrayLayout"]([], 0)
    messages = {
        "/ft": kinds["geometry_msgs/msg/WrenchStamped"](header, kinds["geometry_msgs/msg/Wrench"](zero, zero)),
        "/skin": kinds["std_msgs/msg/Float64MultiArray"](layout, np.ones(3)),
    }
    with rosbag2.Writer(path, version=9) as writer:
        for topic, message in messages.items():
            connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
            for k in range(100):
                writer.write(connection, k * 10**7, store.serialize_cdr(message, message.__msgtype__))


@pytest.mark.slow
@pytest.mark.skipif(not Path(sys.prefix, ".report").exists(), reason="this environment was not made by make")
def test_the_first_commands_of_a_newcomer(tmp_path):
    """In a folder with the files of the repository that `make demo` reads, and the environment that is there."""
    for name in ("Makefile", "data"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "pyproject.toml").touch()
    os.utime(tmp_path / "pyproject.toml", (0, 0))  # older than the environment, which is left as it is
    first, *_ = [text for *_, text in blocks(ROOT / "docs" / "own-skin.md")]
    demo, *_ = [text for *_, text in blocks(ROOT / "README.md")]
    assert demo.startswith("make demo ")
    assert first.startswith("make demo\n")
    done = subprocess.run(
        ["bash", "-ec", f"{first}\npwd; jaxeit --version"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    *_, folder, version = done.stdout.splitlines()
    assert Path(folder).name == "my-skin"
    assert version.startswith("jaxeit ")
    assert (tmp_path / "demo" / "report.html").stat().st_size > 100_000


@pytest.mark.slow
def test_the_commands_about_import(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seconds = {"t": np.arange(50) / 100, "f": np.ones(50), "p": np.ones(50)}
    wide = ",".join(["t", *(f"v{k}" for k in range(550)), '"p, left"', '"p, right"'])
    for name, header in (("day1", "t,load"), ("states", "a,b,c,d,e"), ("sensor", ",".join("abcdefghijklmnop"))):
        write_table(f"{name}.csv", header)
    (tmp_path / "day2.csv").write_text("t,load\n" + "".join(f"{300 + k},1\n" for k in range(50)))
    for name in ("a", "b"):
        np.savez(f"{name}.npz", f=np.arange(50.0))
    savemat("run.mat", {"run": seconds})
    write_bag(tmp_path / "bag")
    tables = iter(["ms,1,2,3,4,p,f", wide])
    lines = list(commands("import.md"))
    assert len(lines) == 7
    for line in lines:
        if " log.csv " in line:
            write_table("log.csv", next(tables))
        do(line)
        with calib.open_session("session.h5") as session:
            assert all(np.isfinite(stream.read()).all() for stream in session.streams.values()), line


@pytest.mark.slow
def test_the_commands_about_logs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, gain in (("log", 400), ("other", 400), ("later", 410), ("a-week-later", 420)):
        write_log(f"{name}.h5", gain)
    with calib.open_session("log.h5") as session:
        force, pressure = (session.streams[name] for name in ("force", "pressure"))
        columns = [1e-6 * force.time, *np.zeros((4, len(force.time))), 1e-5 * pressure.read()[:, 0], force.read()[:, 0]]
    np.savetxt("log.csv", np.stack(columns, 1), "%.9g", ",")
    Path("log.h5").unlink()
    first, *rest, live = commands("logs.md")
    do(first)
    for line in rest:
        do(line)
    do(live, *SHORT, **{"tcp://HOST:PORT": "replay://later.h5"})
    assert int(re.findall(r"(\d+) frames$", capsys.readouterr().err, re.MULTILINE)[-1]) > 0
    assert calib.load_calibration("new.h5").shift is not None
    assert {path.name for path in tmp_path.glob("*")} >= {"report.html", "forces.h5", "calibration.h5"}


@pytest.mark.slow
def test_the_commands_about_ros(folder, monkeypatch, capsys):
    """With a stand-in for the calls of rclpy, which is not on an index of packages."""
    assert main(["apply", "calibration.h5", "use.h5", "-o", "forcemap.h5"]) == 0
    *export, ros, foxglove, again, back = commands("ros.md")
    for line in export:
        do(line)
    assert (folder / "bag" / "metadata.yaml").exists()
    shutil.rmtree("recording")
    do(again)
    do(back)
    with calib.open_session("again.h5") as found, calib.open_session("session.h5") as given:
        wanted = given.streams["eit"].read()
        np.testing.assert_allclose(found.streams["eit"].read(), wanted, atol=1e-6 * np.abs(wanted).max())
    replay, node = "replay://use.h5", FakeRos()
    for name, module in node.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    do(ros, *SHORT, URL=replay)
    assert {call[1] for call in node.log if call[0] == "publish"} > {"/skin/force_map", "/skin/taxels"}
    pytest.importorskip("foxglove")
    do(foxglove.replace("URL", replay).replace("--foxglove", "--foxglove 0"), *SHORT)
    assert int(re.findall(r"(\d+) frames$", capsys.readouterr().err, re.MULTILINE)[-1]) > 0


def do_served(line, *more):
    """Run a command with the addresses of a served recording in place of those of its devices."""
    with served(["simulate", "ideal", "-o", "use.h5", "--serve"]) as urls:
        words = shlex.split(line)[1:]
        given = [urls.get(before, word) for before, word in zip(["", *words], words, strict=False)]
        assert main([*given, *more]) == 0, line


WALK = np.linspace([0.02, 0.05, 0.0], [0.16, 0.05, 0.0], 500, dtype="f4")
"""Places of a stage (500, 3) m."""


def do_with_devices(line, *more):
    """Run a command with a device of its own behind each address, over TCP or a serial port as the address says."""
    words = shlex.split(line)[1:]
    links = {k: (words[k - 1].removeprefix("--"), word) for k, word in enumerate(words) if "://" in word}
    walk = frame_packets(STREAM_KINDS["stage"].number, range(0, 10**10, 2 * 10**7), WALK)
    text = ((k * 10**7, b"%d, 1.5, 2.5, 3.5, 4.5\r\n" % (10_000 * k)) for k in range(1000))  # ticks, values in kPa
    given = {"stage": walk, "text": text}
    kinds = ["text" if "format=csv" in word else name for name, word in links.values()]
    streams = [given.get(kind) or recording_packets("use.h5", [kind]) for kind in kinds]
    ports = [None if word.startswith("serial://") else 0 for _, word in links.values()]
    with SimulatedDevice(streams, ports) as device:
        for k, url in zip(links, device.urls, strict=True):
            words[k] = url + "".join(words[k].partition("?")[1:])
        assert main([*words, *more]) == 0, line


@pytest.mark.slow
def test_the_commands_about_recording(folder, capsys):
    record, recover, live, serve, _ = commands("live.md")
    do_served(record, "-o", "recorded.h5", "--seconds", "1")
    journal("session.h5.part", both(), end=False)
    (folder / "session.h5").unlink()
    do(recover)
    do_served(live, *SHORT)
    assert int(re.findall(r"(\d+) frames$", capsys.readouterr().err, re.MULTILINE)[-1]) > 0
    assert shlex.split(serve)[-1] == "--serve"  # as `served` does, of a recording that is there


def test_the_command_about_lines_of_text(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (line,) = commands("wire-format.md")
    do_with_devices(line, "--seconds", "1")
    with calib.open_session("session.h5") as session:
        (stream,) = session.streams.values()
        values = stream.read()
        assert "serial" in stream.transport
    assert len(values) > 20
    np.testing.assert_allclose(values, np.tile([1500, 2500, 3500, 4500], (len(values), 1)))  # Pa


@pytest.mark.slow
def test_the_viewer_of_rerun(folder, capsys):
    """With a server of rerun that opens no window."""
    pytest.importorskip("rerun")
    ((_, viewer, _),) = [
        text.splitlines() for _, _, text in blocks(ROOT / "docs" / "live.md") if "rerun --bind" in text
    ]
    program, *words = shlex.split(viewer.partition(" &")[0])
    *_, live = commands("live.md")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    command = [str(Path(sys.executable).with_name(program)), *words, "--serve-grpc", "--port", port]
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, **output, start_new_session=True) as server:  # a script that starts the server
        try:
            assert any("listening" in line.lower() for line in server.stdout)
            do(f"{live} 127.0.0.1:{port}", *SHORT, URL="replay://use.h5")
        finally:
            os.killpg(server.pid, signal.SIGTERM)
    do(f"{live} show.rrd", *SHORT, URL="replay://use.h5")
    assert (folder / "show.rrd").stat().st_size > 100_000
    told = capsys.readouterr().err
    assert min(int(count) for count in re.findall(r"(\d+) frames$", told, re.MULTILINE)) > 0


def test_the_command_of_the_checklist(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SESSIONS / "testbed_presses.h5", "use.h5")
    Path("my_skin.toml").write_text(je.load_skin("testbed").toml)
    (line,) = commands("checklist.md")
    do_with_devices(line, "--seconds", "1")
    with calib.open_session("session.h5") as session:
        assert session.streams.keys() == {"eit", "pressure", "force", "stage"}
        assert "tcp" in session.stream("stage").transport
        assert "serial" in session.stream("pressure").transport
        place = session.stream("stage").read()
    assert len(place) > 20
    assert np.isin(place, WALK).all()


@pytest.mark.slow
def test_the_command_about_mujoco(tmp_path, monkeypatch):
    """With the robot of the program on that page."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "mujoco.md").read_text(encoding="utf-8")
    Path("robot.xml").write_text(re.search(r'from_xml_string\("""(.*?)"""', page, re.DOTALL)[1])
    (line,) = commands("mujoco.md")
    do(line, "--fidelity", "draft", **{"10": "0.5"})
    with calib.open_session("rolling.h5") as session:
        assert session.truth["load"].any()


@pytest.mark.slow
def test_the_commands_a_week_later(folder):
    record, with_force, without = commands("a-week-later.md")
    do_with_devices(record, "--seconds", "1")
    with calib.open_session("later.h5") as session:
        assert session.streams.keys() == {"eit", "pressure", "force"}
    do(with_force, **{"later.h5": "session.h5"})
    do(without, "--from", "use", "--force", **{"use.h5": "session.h5"})
    assert calib.load_calibration("new.h5").recalibration is not None


@pytest.mark.slow
def test_the_command_that_trains(tmp_path, monkeypatch):
    """For the skin of the tutorial, on few frames."""
    monkeypatch.chdir(tmp_path)
    write_files(ROOT / "docs" / "own-skin.md", tmp_path)
    Path("my_skin.toml").rename("SKIN.toml")
    (line,) = commands("proposal.md")
    do(line, "--frames", "8192", "--epochs", "1")
    assert je.contacts.load_proposal("proposal.npz").pads == 2


@pytest.mark.slow
def test_the_commands_about_training_frames(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in commands("training-frames.md"):
        do(line, **{"1000000": "40", "8": "1"})
    assert (tmp_path / "frames" / "card.json").exists()
    assert list((tmp_path / "tables").glob("*.parquet"))


def test_the_recipe_of_the_page_on_commands_is_read():
    (text,) = [text for language, _, text in blocks(ROOT / "docs" / "commands.md") if language == "toml"]
    recipe = calib.Recipe.from_toml(text)
    assert isinstance(recipe.imaging.hyperparameter, je.imaging.LCurve)
    assert isinstance(recipe.location, calib.PadEdge)


def write_tanks(folder):
    """The files that the page on tanks names: of PyEIDORS, an instrument, the Kuopio challenge and readings alone."""
    rod = tank_with_rod()
    write_csv(folder / "tank_55uA_1000Hz.csv", rod.frames)
    (folder / "recording.get").write_bytes(goe_get(-np.resize(rod.frames, (121, rod.frames.shape[1]))))
    write_ktc(folder, je.Fidelity.draft(order=2, edge_length=0.03))
    write_files(ROOT / "docs" / "tanks.md", folder)
    model = je.discretise(je.Scene(je.load_skin(folder / "tank.toml")), je.Fidelity.draft())
    touched = jnp.linalg.norm(model.centroids - jnp.array([0.05, 0.03]), axis=1) < 0.02
    frames = np.stack([je.forward(model), je.forward(model, jnp.where(touched, 2, 1) * model.background)])
    savemat(folder / "frames.mat", dict(zip(("vh", "vi"), frames[:, :, None], strict=True)))
    np.savez(folder / "frames.npz", frames=frames)


@pytest.mark.slow
def test_the_commands_about_tanks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_tanks(tmp_path)
    lines = list(commands("tanks.md"))
    assert len(lines) == 7
    for line in lines:
        do(line)
        picture = Path(shlex.split(line)[-1])
        assert picture.read_bytes().startswith(b"\x89PNG")
        picture.unlink()


def fragments(page):
    """The programs of a page that go on from objects of the reader."""
    return [text for language, _, text in blocks(ROOT / "docs" / page) if language == "py"]


@pytest.mark.slow
def test_programs_that_go_on_from_objects_of_the_reader(folder):
    calibration, names = calib.load_calibration("calibration.h5"), {"calib": calib, "je": je}
    model = je.discretise(je.Scene(calibration.skin), je.Fidelity.draft())
    v0 = je.forward(model)
    noise, places = jnp.full(len(v0), 1e-4 * float(jnp.abs(v0).max())), jnp.array([[0.05, 0.13], [0.14, 0.06]])
    bumps = jnp.exp(-jnp.sum((model.centroids - places[:, None]) ** 2, -1) / (2 * 0.01**2))
    dv = jnp.stack([je.forward(model, model.background * (1 + 0.4 * bump)) - v0 for bump in bumps])
    tracker = je.tracking.prepare_tracker(model, calibration.skin, noise=noise, sigma=model.background)
    now = tracker.step(tracker.start(), dv[0], 0.01)
    given = {"calibration": calibration, "points": np.asarray(places), "tracker": tracker, "now": now, "model": model}
    with calib.open_session("session.h5") as session:  # many presses: of few, no layer is learned
        names |= given | {"session": session, "sessions": [session], "noise": noise, "v0": v0, "pad_errors": None}
        names |= {"skin": calibration.skin, "dv": dv, "places": places}
        (learned, round_tips), layers = fragments("loads.md"), fragments("contact-layer.md")
        presses = calibration.probes
        taught = {"frames": presses.dv, "places": presses.position, "forces": presses.force}
        exec(compile(learned, "loads.md", "exec"), names | {key: part[:6] for key, part in taught.items()})
        assert len(layers) == 2
        for program in (round_tips, *layers):
            exec(compile(program, "loads.md, contact-layer.md", "exec"), names)
        (electrodes,) = fragments("electrodes.md")
        exec(compile(electrodes, "electrodes.md", "exec"), names)
    assert np.isfinite(names["mean"]).all()
    assert len(names["tracks"]) == len(now.tracks)
    assert float(jnp.abs(names["fit"].shift).max()) < 1e-3
