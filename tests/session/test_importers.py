"""Import of foreign tables: what is kept, converted, counted and refused."""

import argparse
import gzip
import os
from datetime import UTC, datetime
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import jaxeit as je
from calib.calibration.logs.procedure import calibrate_logs, render_log
from calib.cli import main
from calib.session import SessionError, Status, file_hash, importers, open_session
from calib.session.importers import CsvImporter, ImportReport, StatedFacts, add_arguments, import_csv, run
from calib.session.importers.tables.columns import parse_stream, parse_time
from calib.session.importers.tables.sentinels import sentinel_warnings

from ..helpers import REAL_DATA

needs_real_data = pytest.mark.skipif(not REAL_DATA.is_dir(), reason="the measured data are not here")


def load(*words: object, folder: Path, sort: bool = False) -> ImportReport:
    """Import as typed at the command line, into ``folder/s.h5``."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args(["csv", *map(str, words), "-o", str(folder / "s.h5"), *(["--sort"] if sort else [])])
    return CsvImporter.convert(args, Path(args.output), StatedFacts())


def table(folder: Path, text: str, name: str = "log.csv") -> Path:
    """A text file."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def stream(folder: Path, name: str) -> np.ndarray:
    """A stream of ``folder/s.h5`` as read back."""
    with open_session(folder / "s.h5") as s:
        return s.streams[name].read()


LAYOUTS = {
    "comma": "0,1.5,-2\n10,2.5,-3\n20,3.5,-4\n",
    "tab": "0\t1.5\t-2\n10\t2.5\t-3\n20\t3.5\t-4\n",
    "space": "  0   1.5 -2\n 10   2.5 -3\n 20 3.5   -4\n",
    "semicolon and decimal comma": "0;1,5;-2\n10;2,5;-3\n20;3,5;-4\n",
    "header": "time (ms),load,x\n0,1.5,-2\n10,2.5,-3\n20,3.5,-4\n",
    "quoted": '"time","load","x"\n"0","1.5","-2"\n"10","2.5","-3"\n"20","3.5","-4"\n',
    "space and decimal comma": "0 1,5 -2\n10 2,5 -3\n20 3,5 -4\n",
    "a short row": "0,1.5,-2\n10,2.5,-3\n20,3.5,-4\nend\n",
    "comments and gaps": "# by hand\n\n0, 1.5, -2\n10, 2.5, -3\n\n20, 3.5, -4\n",
    "byte order mark": "\ufeff0,1.5,-2\r\n10,2.5,-3\r\n20,3.5,-4\r\n",
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts(layout: str, tmp_path: Path) -> None:
    path = table(tmp_path, LAYOUTS[layout])
    words = ["--time", "0:ms", "--stream", "load=1:kPa", "--stream", "x=2:mm"]
    report = load(path, *words, folder=tmp_path)
    with open_session(tmp_path / "s.h5") as s:
        load_stream, x = s.streams["load"], s.streams["x"]
        assert (load_stream.variable, load_stream.unit, x.variable) == (
            "pressure",
            "Pa",
            "position",
        )
        np.testing.assert_array_equal(load_stream.time, [0, 10_000_000, 20_000_000])
        np.testing.assert_allclose(load_stream.read()[:, 0], [1500.0, 2500.0, 3500.0])
        np.testing.assert_allclose(x.read()[:, 0], [-2e-3, -3e-3, -4e-3])
        assert load_stream.nominal_rate == pytest.approx(100)
    assert report.files[0].rows_read - report.files[0].rows_without_time == 3


def test_columns_by_name_and_range_from_gzip(tmp_path: Path) -> None:
    path = tmp_path / "log.csv.gz"
    rows = "".join(f"{i},{i},{i + 1},{i + 2}\n" for i in range(5))
    path.write_bytes(gzip.compress(f"t,a,b,c\n{rows}".encode()))
    load(path, "--time", "t:s", "--stream", "p=c,a:g", "--stream", "q=1-3:counts", folder=tmp_path)
    grams = np.arange(5.0)[:, None] + [2, 0]
    np.testing.assert_allclose(stream(tmp_path, "p"), grams * 9.80665e-3)
    np.testing.assert_array_equal(stream(tmp_path, "q"), np.arange(5.0)[:, None] + [0, 1, 2])


HEADERS = {
    "time (ms),x (mm),y (mm),load (g)": ",",
    "Time [ms];X [mm];Y [mm];Load [g]": ";",
    "time/ms\tx/mm\ty/mm\tload/g": "\t",
    "time_ms,x_mm,y_mm,load_g": ",",
}


@pytest.mark.parametrize("header", HEADERS)
def test_units_in_the_header_need_not_be_repeated(header: str, tmp_path: Path) -> None:
    rows = [HEADERS[header].join(row) for row in (("0", "10", "-5", "100"), ("10", "11", "-6", "200"))]
    path = table(tmp_path, "\n".join([header, *rows]))
    load(path, "--time", "time", "--stream", "stage=x,y", "--stream", "force=load", folder=tmp_path)
    np.testing.assert_allclose(stream(tmp_path, "stage"), [[0.010, -0.005], [0.011, -0.006]])
    np.testing.assert_allclose(stream(tmp_path, "force")[:, 0], [0.1 * 9.80665, 0.2 * 9.80665])
    with open_session(tmp_path / "s.h5") as s:
        np.testing.assert_array_equal(s.streams["stage"].time, [0, 10_000_000])
        assert s.streams["stage"].variable == "position"
    with pytest.raises(SessionError, match="does not say one for all"):
        load(path, "--time", "time", "--stream", "both=x,load", folder=tmp_path)


def test_the_skin_and_its_protocol_go_with_the_readings(skin: je.Skin, tmp_path: Path) -> None:
    count = len(skin.protocol.pattern)
    rows = "".join(",".join(map(str, [i, *range(count + 4)])) + "\n" for i in range(3))
    spec = [str(table(tmp_path, rows)), "--time", "0:s"]
    pads = f"pressure={count + 1}-{count + 4}:kPa"
    parser = argparse.ArgumentParser()
    add_arguments(parser)

    def brought(*words: str) -> None:
        run(parser.parse_args(["csv", *spec, *words, "-o", str(tmp_path / "s.h5"), "--skin", "testbed"]), skin)

    brought("--stream", f"eit=1-{count}:V", "--stream", pads)
    with open_session(tmp_path / "s.h5") as s:
        assert (s.skin_name, s.skin_toml) == (skin.name, skin.toml)
        np.testing.assert_array_equal(s.pattern, skin.protocol.pattern)
    for words, said in (
        (["--stream", pads], "no stream is called eit"),
        (["--stream", f"eit=1-{count - 1}:V"], f"{count - 1} columns; the skin testbed has {count} readings"),
        (["--stream", f"eit=1-{count}:V", "--stream", "pressure=1-3:Pa"], "3 columns; the skin testbed has 4 pads"),
    ):
        with pytest.raises(SessionError, match=said):
            brought(*words)


def test_files_keep_their_own_options_and_share_one_epoch(tmp_path: Path) -> None:
    a = table(tmp_path, "1700000000.5,1\n1700000001.5,-1\n", "a.csv")
    b = table(tmp_path, "1700000001.25,-1\n1700000001.75,7\n", "b.csv")
    words = [a, "--time", "0:s", "--stream", "f=1:N", "--missing", "-1"]
    report = load(*words, "--from", b, "--time", "0:s", "--stream", "c=1:counts", folder=tmp_path)
    assert report.epoch == datetime.fromtimestamp(1_700_000_000, UTC)
    with open_session(tmp_path / "s.h5") as s:
        np.testing.assert_allclose(s.streams["f"].time, [5e8, 15e8], atol=500)
        np.testing.assert_allclose(s.streams["c"].time, [12.5e8, 17.5e8], atol=500)
        np.testing.assert_array_equal(s.streams["f"].read()[:, 0], [1.0, np.nan])
        np.testing.assert_array_equal(s.streams["c"].read()[:, 0], [-1.0, 7.0])
        assert s.streams["f"].status().tolist() == [0, Status.nonfinite]


def test_cells_that_are_no_numbers_are_counted(tmp_path: Path) -> None:
    path = table(tmp_path, "0,1\n1,bad\n2,nan\n3\n4,1_0\n5,inf\nx,6\n7,7\n")
    report = load(path, "--time", "0:s", "--stream", "f=1:N", folder=tmp_path)
    found = report.files[0]
    assert (found.rows_without_time, found.first_without_time) == (1, 7)
    assert (found.streams[0].not_numbers, found.streams[0].first_not_number) == (5, 2)
    np.testing.assert_array_equal(stream(tmp_path, "f")[:, 0], [1] + [np.nan] * 5 + [7])
    assert "5 cells are not numbers (first: line 2)" in report.summary()


@pytest.mark.parametrize("bits", [16, 24, 32])
def test_a_counter_that_begins_anew_goes_on(bits: int, tmp_path: Path) -> None:
    """As `micros()` of an Arduino does after 71.6 minutes."""
    counts = (2**bits - 5000 + 1000 * np.arange(12)) % 2**bits
    path = table(tmp_path, "t,f\n" + "".join(f"{count},{number}\n" for number, count in enumerate(counts)))
    report = load(path, "--time", "0:us", "--stream", "f=1:N", folder=tmp_path)
    assert (report.files[0].wraps, report.files[0].rows_sorted) == (1, 0)
    assert "the counter of the clock began anew 1 times" in report.summary()
    with open_session(tmp_path / "s.h5") as session:
        np.testing.assert_array_equal(np.diff(session.streams["f"].time), 1_000_000)
    np.testing.assert_array_equal(stream(tmp_path, "f")[:, 0], np.arange(12))


@pytest.mark.parametrize("counts", [[100, 200, 300, 0, 100], [65400, 65500, 30000, 30100], [1.5, 65535.5, 0.5]])
def test_a_clock_that_was_set_back_is_no_counter_at_its_end(counts: list[float], tmp_path: Path) -> None:
    path = table(tmp_path, "t,f\n" + "".join(f"{count},1\n" for count in counts))
    with pytest.raises(SessionError, match="goes back at 1 rows"):
        load(path, "--time", "0:us", "--stream", "f=1:N", folder=tmp_path)


def test_repeated_times_are_dropped_and_backward_ones_need_sort(tmp_path: Path) -> None:
    path = table(tmp_path, "t,f\n0,1\n1,2\n1,3\n3,4\n2,5\n")
    words = [path, "--time", "0:s", "--stream", "f=1:N"]
    with pytest.raises(SessionError, match="goes back at 1 rows, first at line 6"):
        load(*words, folder=tmp_path)
    assert os.listdir(tmp_path) == ["log.csv"]
    report = load(*words, folder=tmp_path, sort=True)
    assert (report.files[0].equal_times, report.files[0].first_equal_time) == (1, 4)
    assert report.files[0].rows_sorted == 1
    np.testing.assert_array_equal(stream(tmp_path, "f")[:, 0], [1, 2, 5, 4])


def test_a_clock_of_whole_seconds_is_pointed_out(tmp_path: Path) -> None:
    path = table(tmp_path, "".join(f"{k // 20},{k}\n" for k in range(400)))
    said = load(path, "--time", "0:s", "--stream", "f=1:N", folder=tmp_path).warnings[0]
    assert said.startswith(
        "log.csv: 380 of 400 rows are left out, since they have the time of another: if the clock is"
    )
    assert said.endswith("give the rate of the rows in its place (about --rate 20)")


def test_sentinels_are_pointed_out_but_resting_values_are_not() -> None:
    rng = np.random.default_rng(0)
    force = np.linspace(0, 50, 1000) + rng.normal(size=1000)
    held = np.where(np.arange(1000) % 2 == 0, -1.0, force)
    assert "500 of 1,000 rows of force are exactly -1" in sentinel_warnings("force", held[:, None])[0]
    beyond = np.where(np.arange(1000) % 3 == 0, 9999.0, force)
    said = sentinel_warnings("p", np.stack([force, beyond], axis=1))
    assert [line.split(":")[0] for line in said] == ["334 of 1,000 rows of p[1] are exactly 9999"]
    counts = np.rint(rng.normal(size=1000) * 2)
    assert (counts == -1).mean() > 0.05
    assert sentinel_warnings("counts", counts[:, None]) == ()
    assert sentinel_warnings("force", np.where(held == -1, np.nan, held)[:, None]) == ()


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    path = table(tmp_path, LAYOUTS["comma"])
    hashes = set()
    for _ in range(2):
        load(path, "--time", "0:ms", "--stream", "f=1:N", folder=tmp_path)
        hashes.add(file_hash(tmp_path / "s.h5"))
    load(path, "--time", "0:ms", "--stream", "f=2:N", folder=tmp_path)
    assert len(hashes) == 1
    assert file_hash(tmp_path / "s.h5") not in hashes


def test_run_prints_the_report(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = table(tmp_path, LAYOUTS["comma"])
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    words = ["csv", str(path), "--time", "0:ms", "--stream", "f=1:N", "-o", str(tmp_path / "s.h5")]
    assert run(parser.parse_args(words)) == 0
    said = capsys.readouterr().out
    assert "f: force in N, 3 x 1, about 100 Hz" in said
    assert "give --epoch" in said
    assert run(parser.parse_args([*words, "--epoch", "2025-01-31T12:00:00Z"])) == 0
    assert "give --epoch" not in capsys.readouterr().out
    with open_session(tmp_path / "s.h5") as s:
        assert s.epoch.startswith("2025-01-31T12:00:00")
        assert not s.simulated
    with pytest.raises(SessionError, match="--epoch soon"):
        run(parser.parse_args([*words, "--epoch", "soon"]))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--stream", "f=1:N"], "--time: missing"),
        (["--time", "0:ms"], "--stream: none given"),
        (["--time", "0:ms", "--stream", "f=7:N"], "columns 0 to 2"),
        (["--time", "0:ms", "--stream", "f=load:N"], "it has no header"),
        (["--time", "0:ms", "--stream", "f=1:N", "--stream", "f=2:N"], "given twice"),
        (["--time", "0:ms", "--stream", "../f=1:N"], "cannot be used"),
        (["--time", "0:mm", "--stream", "f=1:N"], "--time 0:mm"),
        (["--time", "0", "--stream", "f=1:N"], "no unit given"),
        (["--time", "0:ms", "--stream", "f=1"], "add it after a colon"),
        (["--time", "0:ms", "--stream", "f=1:stone"], "use one of"),
    ],
)
def test_requests_that_cannot_be_met(words: list[str], said: str, tmp_path: Path) -> None:
    path = table(tmp_path, LAYOUTS["comma"])
    with pytest.raises(SessionError) as caught:
        load(path, *words, folder=tmp_path)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert os.listdir(tmp_path) == ["log.csv"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "holds no rows"),
        (b"Once upon a time\nthere was, a, robot\nthat felt nothing, at, all\n", "holds no number"),
        (b"0,1,2\n", "only 1 of 1 rows"),
        (bytes(100), "not text"),
        (gzip.compress(b"0,1,2\n1,2,3\n" * 999, mtime=0)[:40], "gzip file is damaged"),
        (b"0,a,2\n1,b,2\n", "hold no number"),
        (b"x" * (1 << 21), "not text"),
    ],
    ids=["empty", "prose", "one row", "zeros", "cut gzip", "words for numbers", "one long line"],
)
def test_files_that_are_no_tables(content: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    with pytest.raises(SessionError) as caught:
        load(path, "--time", "0:s", "--stream", "f=1:N", folder=tmp_path)
    assert said in str(caught.value)
    assert os.listdir(tmp_path) == ["log.csv"]


def test_missing_files_are_named(tmp_path: Path) -> None:
    for name, said in {"none.csv": r"none\.csv: file: does not exist", "x" * 300: r"\(File name too long\)"}.items():
        with pytest.raises(SessionError, match=said):
            load(tmp_path / name, "--time", "0:s", "--stream", "f=1:N", folder=tmp_path)
    with pytest.raises(SessionError, match="no file given; name one"):
        import_csv([], tmp_path / "s.h5")


@pytest.mark.parametrize("text", [":ms", "0:", "0:N", "0:f:", ""])
def test_clocks_must_be_column_and_unit(text: str) -> None:
    with pytest.raises(SessionError, match="COLUMN:UNIT"):
        parse_time(text)


@pytest.mark.parametrize("text", ["f", "f=1:", "=1:N", "f=:N", "f=5-1:N", "f=1-9999999:N"])
def test_streams_must_be_name_columns_unit(text: str) -> None:
    with pytest.raises(SessionError, match="write it as"):
        parse_stream(text)


# --- recordings made by others -------------------------------------------------------------------


@needs_real_data
@pytest.mark.parametrize("name", ["Circle_1bar", "Circle_5bar", "O-ring257_3bar", "Stadium_1bar"])
def test_pneumatic_actuator(name: str, tmp_path: Path) -> None:
    path = REAL_DATA / "pneumatic_actuator" / f"{name}.csv.gz"
    words = ["--stream", "pressure=5:bar", "--stream", "force=6:N", "--stream", "stage=4:mm"]
    report = load(path, "--time", "0:ms", *words, folder=tmp_path)
    raw = np.loadtxt(path)
    assert report.files[0].rows_read == len(raw)
    assert not [w for w in report.warnings if "missing" in w]
    kept = np.concatenate([[True], np.diff(raw[:, 0]) > 0])
    for stream_name, column, factor in [
        ("pressure", 5, 1e5),
        ("force", 6, 1.0),
        ("stage", 4, 1e-3),
    ]:
        np.testing.assert_allclose(stream(tmp_path, stream_name)[:, 0], raw[kept, column] * factor)


@needs_real_data
def test_eflesh(tmp_path: Path) -> None:
    folder = REAL_DATA / "eflesh" / "20250401_014340_probe"
    states, sensor = folder / "states.csv", folder / "sensor_post_baselines.csv"
    silent = load(states, "--time", "0:s", "--stream", "force=4:g", folder=tmp_path)
    assert "of 3,600 rows of force are exactly -1: missing?" in silent.summary()
    words = [states, "--time", "0:s", "--stream", "force=4:g", "--missing", "-1", "--from", sensor]
    report = load(*words, "--time", "0:s", "--stream", "sensor=1-15:counts", folder=tmp_path)
    load_cell = np.loadtxt(states, delimiter=",")[:, 4]
    assert report.files[0].streams[0].declared_missing == (load_cell == -1).sum()
    assert report.warnings == ()
    expected = np.where(load_cell == -1, np.nan, load_cell * 9.80665e-3)
    np.testing.assert_allclose(stream(tmp_path, "force")[:, 0], expected)
    assert stream(tmp_path, "sensor").shape == (3600, 15)


def test_the_slope_of_a_log_is_in_the_unit_of_its_signal(tmp_path: Path) -> None:
    t = np.arange(0, 20, 0.05)
    force = 5 * (1 - np.cos(t))
    rows = np.column_stack([t, force, 200 * force])
    path = tmp_path / "log.csv"
    np.savetxt(path, rows, delimiter=",")
    for columns, unit in (("2:counts", "N/count"), ("2:mV", "N/V")):
        load(path, "--time", "0:s", "--stream", "force=1:N", "--stream", f"signal={columns}", folder=tmp_path)
        with open_session(tmp_path / "s.h5") as s:
            found = calibrate_logs([s])
        assert found.units == (unit,)
        assert f" {unit} (" in render_log("log", found)


# --- a format of another package -----------------------------------------------------------------


class LinesImporter(importers.AbstractImporter):
    """One force a line, at a rate that is given."""

    name = "lines"
    summary = "one number a line"

    @classmethod
    def add_arguments(cls, parser):
        parser.add_argument("file", metavar="FILE")
        parser.add_argument("--rate", type=float, required=True)

    @classmethod
    def convert(cls, args, output, about):
        values = Path(args.file).read_text().split()
        rows = "".join(f"{number / args.rate},{value}\n" for number, value in enumerate(values))
        Path(f"{args.file}.csv").write_text(rows)
        streams = (importers.StreamSpec("force", ("1",), "N"),)
        spec = importers.FileSpec(Path(f"{args.file}.csv"), "0", "s", streams)
        return import_csv([spec], output, **about._asdict())


def test_a_format_of_another_package_is_known_by_its_entry_point(tmp_path, monkeypatch, capsys):
    assert list(importers.importers()) == ["csv", "hdf5", "mat", "mcap", "npz", "parquet"]
    point = EntryPoint("lines", f"{__name__}:LinesImporter", "calib.importers")
    monkeypatch.setattr(importers, "entry_points", lambda group: [point] if group == point.group else [])
    importers.importers.cache_clear()
    try:
        path = table(tmp_path, "1.5\n2.5\n3.5\n", "log.txt")
        main(["import", "lines", str(path), "--rate", "10", "-o", str(tmp_path / "s.h5"), "--title", "by hand"])
        with pytest.raises(SystemExit):
            main(["import", "--help"])
    finally:
        importers.importers.cache_clear()
    np.testing.assert_array_equal(stream(tmp_path, "force")[:, 0], [1.5, 2.5, 3.5])
    with open_session(tmp_path / "s.h5") as s:
        assert s.title == "by hand"
        np.testing.assert_array_equal(s.streams["force"].time, [0, 100_000_000, 200_000_000])
    said = capsys.readouterr().out
    assert "csv" in said
    assert "one number a line" in said


def test_a_format_of_the_user_is_named_by_its_import_path(tmp_path, capsys):
    path = table(tmp_path, "1.5\n2.5\n3.5\n", "log.txt")
    form = f"{__name__}:LinesImporter"
    assert main(["import", form, str(path), "--rate", "10", "-o", str(tmp_path / "s.h5")]) == 0
    np.testing.assert_array_equal(stream(tmp_path, "force")[:, 0], [1.5, 2.5, 3.5])
    with pytest.raises(SystemExit):
        main(["import", form, "--help"])
    assert "--rate" in capsys.readouterr().out


def test_a_module_of_a_format_that_raises_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "broken_format.py").write_text("raise ValueError('no\\nway')")
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["import", "broken_format:Format", "log.txt", "-o", "s.h5"]) == 2
    said = "'broken_format:Format' cannot be imported (ValueError: no?way); correct its module"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("no_such_module:Format", "cannot be imported (No module named 'no_such_module')"),
        (f"{__name__}:NoSuchFormat", "has no attribute 'NoSuchFormat'"),
        (f"{__name__}:StatedFacts", "is not a concrete class derived from AbstractImporter"),
        ("calib.session.importers:AbstractTableImporter", "is not a concrete class derived from AbstractImporter"),
    ],
)
def test_import_paths_that_lead_to_no_format_are_named(path, message, capsys):
    assert main(["import", path, "log.txt", "-o", "s.h5"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"jaxeit: import format {path!r}")
    assert message in said
    assert said.count("\n") == 1


def test_no_other_format_is_taken(capsys):
    with pytest.raises(SystemExit):
        main(["import", "xlsx", "log.xlsx", "-o", "s.h5"])
    assert "no xlsx; choose from csv, hdf5" in capsys.readouterr().err.replace("'", "")


def test_a_table_is_not_replaced_by_the_session_made_of_it(tmp_path):
    text = "t,f\n0,1.5\n10,2.5\n20,3.5\n"
    log = table(tmp_path, text)
    spec = importers.FileSpec(log, time="t", time_unit="ms", streams=(importers.StreamSpec("force", ("f",), "N"),))
    with pytest.raises(SessionError, match=r"log\.csv: file: is also an input, which would be lost; give another"):
        import_csv([spec], log)
    assert log.read_text(encoding="utf-8") == text
