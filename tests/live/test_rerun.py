"""The optional view in rerun: what a file of it holds, read back."""

import sys

import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration.localisation.ellipses import INSIDE_90
from calib.cli import main
from calib.live.loop import LiveControl
from calib.live.results import FrameResult, TouchEstimates
from tests.helpers import stand_in

ROWS, COLUMNS = 3, 4
S = 1_000_000_000


def test_without_rerun_the_option_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    streams = ["--eit", "tcp://127.0.0.1:1", "--pressure", "tcp://127.0.0.1:1"]
    assert main(["live", "--calibration", str(tmp_path / "c.h5"), *streams, "--rerun"]) == 2
    assert "pip install 'jaxeit[viewer]'" in capsys.readouterr().err


@pytest.fixture(scope="module")
def view():
    """The module, where rerun is installed."""
    pytest.importorskip("rerun")
    from calib.live.views import rerun_view  # noqa: PLC0415  it needs the optional extra

    return rerun_view


@pytest.fixture
def calibration():
    """Of a sheet of 3 by 4 pixels of 10 mm, with two pads."""
    x, y = np.meshgrid(0.01 * np.arange(COLUMNS), 0.01 * np.arange(ROWS))
    pads = [stand_in(je.Pad, name="left"), stand_in(je.Pad, name="the right")]
    centres = np.stack([x.ravel(), y.ravel()], 1)
    return stand_in(
        calib.Calibration,
        skin=stand_in(je.Skin, name="small", pads=pads),
        recon=stand_in(je.Reconstructor, centres=centres, shape=(ROWS, COLUMNS)),
        simulated=True,
    )


def result(number, **changes):
    """Frame `number`, 10 ms after the one before; a contact at (20, 10) mm."""
    values = {
        "number": number,
        "host": number * S // 100,
        "latency": 0.001 * number,
        "force": np.array([float(number), np.nan]),
        "standard_error": np.array([0.1, np.nan]),
        "half_width": np.array([0.16, np.nan]),
        "valid": np.array([True, False]),
        "centre": np.array([[0.02, 0.01], [np.nan, np.nan]]),
        "map": np.arange(ROWS * COLUMNS, dtype=float),
        "image": -1e-3 * np.arange(ROWS * COLUMNS),
        "missing": 0,
        "dropped": 3,
        "touches": TouchEstimates(np.array([[0.02, 0.01]]), np.diag([4e-6, 1e-6])[None], np.array([True]), 0),
    }
    return FrameResult(**{**values, **changes})


def rows_of(path):
    """What a file holds: by entity and component, a list of (time in s, value)."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(path)
    found = {}
    for chunk in reader.stream():
        table = chunk.to_record_batch()
        if "arrival" not in table.schema.names:
            continue
        times = [at / S for at in table["arrival"].cast("int64").to_pylist()]  # ns, which datetime does not take
        for name in table.schema.names:
            if ":" in name:
                found.setdefault((chunk.entity_path, name), []).extend(zip(times, table[name].to_pylist(), strict=True))
    return found


def test_a_file_holds_every_force_and_the_newest_pictures(view, calibration, tmp_path):
    path = tmp_path / "show.rrd"
    with view.RerunView(calibration, LiveControl(state="running"), str(path)) as shown:
        for number in range(1, 51):
            shown.show_result(result(number))
    found = rows_of(path)
    forces = found["/force/left", "Scalars:scalars"]
    np.testing.assert_allclose([(at, *value) for at, value in forces], [(0.01 * n, n + 1) for n in range(50)])
    assert np.isnan([force for _, (force,) in found["/force/the_right", "Scalars:scalars"]]).all()
    assert [value for _, (value,) in found["/standard_error/left", "Scalars:scalars"]] == [0.1] * 50
    assert found["/latency_ms", "Scalars:scalars"][-1][1] == pytest.approx([50.0])
    at, (buffer,) = found["/map", "DepthImage:buffer"][-1]
    assert at == pytest.approx(0.49)
    expected = np.arange(12.0).reshape(ROWS, COLUMNS)[::-1]  # the highest row on top
    np.testing.assert_array_equal(np.frombuffer(bytes(buffer), "f4").reshape(ROWS, COLUMNS), expected)
    (buffer,) = found["/image", "DepthImage:buffer"][-1][1]
    np.testing.assert_allclose(np.frombuffer(bytes(buffer), "f4").reshape(ROWS, COLUMNS), 1e-3 * expected, rtol=1e-6)
    assert found["/about", "TextDocument:text"][-1][1] == ["small, SIMULATED: running"]


def test_contacts_are_drawn_where_they_are_with_their_errors(view, calibration, tmp_path):
    path = tmp_path / "show.rrd"
    with view.RerunView(calibration, LiveControl(), str(path)) as shown:
        shown.show_result(result(1))
    found = rows_of(path)
    ((strip,),) = [values for _, values in found["/map/contacts", "LineStrips2D:strips"]]
    strip = np.array(strip)
    np.testing.assert_allclose(strip[:-1].mean(0), [2.5, 1.5], atol=1e-6)  # the middle of the third column, second row
    np.testing.assert_allclose(np.ptp(strip, axis=0), 2 * INSIDE_90 * np.array([0.2, 0.1]), rtol=1e-3)
    assert found["/map/contacts", "LineStrips2D:labels"][-1][1] == ["20.0, 10.0 mm ± 2.0, 1.0"]
    assert found["/map/centres", "Points2D:labels"][-1][1] == ["left 1.0 N"]
    np.testing.assert_allclose(found["/map/centres", "Points2D:positions"][-1][1], [[2.5, 1.5]])


def test_nowhere_to_send_results_is_said(view, calibration, tmp_path):
    path = tmp_path / "show.rrd"
    path.write_bytes(b"mine")
    for where, words in ((str(path), "exists already"), ("127.0.0.1:1", "no viewer"), ("nonsense", "no viewer")):
        with pytest.raises(view.RerunError, match=words), view.RerunView(calibration, LiveControl(), where):
            pass
    assert path.read_bytes() == b"mine"


def test_results_are_taken_at_once(view, calibration, tmp_path):
    """A thousand of them while nothing is sent: what is drawn is the newest."""
    shown = view.RerunView(calibration, LiveControl(), str(tmp_path / "show.rrd"))
    for number in range(10_000):
        shown.show_result(result(number))
    assert len(shown._waiting) == 4096
    with shown:
        pass
    found = rows_of(tmp_path / "show.rrd")
    assert len(found["/force/left", "Scalars:scalars"]) == 4096
    assert len(found["/map", "DepthImage:buffer"]) == 1
