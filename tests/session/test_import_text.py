"""Import of tables of text as pandas, Excel and loggers write them: the right columns, or one clear line."""

import gzip
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.cli import main
from calib.session import SessionError, Status, open_session
from calib.session.importers import limits
from calib.session.importers.formats import text_files
from calib.session.importers.formats.csv_tables import CsvFile
from jaxeit.budget import Budget

TIME = np.arange(5) / 4
PRESSURE = np.array([0.5, 1.25, -2.5, 1000.75, 3.0])
FORCE = np.array([9.5, 8.5, 7.5, 6.5, 5.5])
NAMES = ("t", "p, left", "f", "g")
"""The column g holds other numbers than f, so that an exchange of the two shows."""


def written(folder: Path, text: str, name: str = "log.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def brought(path: Path | list[Path], *words: str) -> dict[str, np.ndarray]:
    """Import as typed at the command line; the streams."""
    paths = path if isinstance(path, list) else [path]
    output = paths[0].with_name("s.h5")
    args = ["import", "csv", *map(str, paths), *words, "-o", str(output)]
    assert main(args) == 0
    with open_session(output) as session:
        found = {name: stream.read() for name, stream in session.streams.items()}
        return found | {"time": session.streams["force"].time, "status": session.streams["force"].status()}


def refusal(capsys: pytest.CaptureFixture, path: Path | list[Path], *words: str) -> str:
    """The line that an import ends with; no file is left."""
    paths = path if isinstance(path, list) else [path]
    output = paths[0].with_name("s.h5")
    assert main(["import", "csv", *map(str, paths), *words, "-o", str(output)]) == 2
    assert not output.exists()
    assert not list(output.parent.glob(".*tmp"))
    (line,) = capsys.readouterr().err.splitlines()
    return line


def as_text(delimiter: str, decimal: str, quote_all: bool, line_end: str, names: tuple[str, ...] = NAMES) -> str:
    """A table as the csv module and `pandas.DataFrame.to_csv` write it: cells are quoted where they need it."""

    def cell(value: object) -> str:
        text = value if isinstance(value, str) else f"{value:.12g}".replace(".", decimal)
        return f'"{text}"' if quote_all or delimiter in text else text

    rows = [names, *zip(TIME, PRESSURE, FORCE, -FORCE, strict=True)]
    return line_end.join(delimiter.join(map(cell, row)) for row in rows) + line_end


WRITERS = {
    "pandas": (",", ".", False, "\n"),
    "pandas, every cell quoted": (",", ".", True, "\n"),
    "pandas, decimal comma": (",", ",", False, "\n"),
    "pandas, decimal comma and semicolon": (";", ",", False, "\n"),
    "Excel, German": (";", ",", False, "\r\n"),
    "Excel, English": (",", ".", False, "\r\n"),
    "Excel, tabs, German": ("\t", ",", False, "\r\n"),
    "old Macintosh": (",", ".", False, "\r"),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("writer", WRITERS)
def test_what_was_written_is_what_is_read(writer, encoding, tmp_path):
    path = written(tmp_path, as_text(*WRITERS[writer]), encoding=encoding)
    found = brought(path, "--time", "t:s", "--stream", 'pressure="p, left":kPa', "--stream", "force=f:N")
    np.testing.assert_allclose(found["pressure"][:, 0], 1e3 * PRESSURE, rtol=1e-12)
    np.testing.assert_array_equal(found["force"][:, 0], FORCE)
    np.testing.assert_array_equal(found["time"], TIME * 1e9)


def test_a_name_that_holds_a_comma_is_told_as_it_is_to_be_written(tmp_path, capsys):
    path = written(tmp_path, '"t","p, left","f"\n0,1,2\n1,4,5\n')
    told = refusal(capsys, path, "--time", "t:s", "--stream", "pressure=p, left:kPa")
    assert """column 'p': not there; header names: t, "p, left", f;""" in told


def test_numbered_columns_are_told_as_a_range(tmp_path, capsys):
    names = [f"U{k} [mV]" for k in range(1, 41)]
    path = written(tmp_path, ",".join(["Time [ms]", *names, "Fz [N]"]) + "\n" + "1," * 41 + "1\n")
    told = refusal(capsys, path, "--time", "time:ms", "--stream", "force=load:N")
    assert "header names: Time [ms], U1 [mV]-U40 [mV], Fz [N]; use one of them" in told


def test_the_nearest_name_is_told_and_units_of_another_quantity_are_refused(tmp_path, capsys):
    path = written(tmp_path, "t,force_z,p\n0,1,2\n1,4,5\n")
    told = refusal(capsys, path, "--time", "t:s", "--stream", "force=forcez:N")
    assert "column 'forcez': not there; did you mean 'force_z'?" in told
    told = refusal(capsys, path, "--time", "t:s", "--stream", "pressure=p:N")
    assert "--stream pressure: N is no unit of what a stream of this name measures (Pa, hPa, " in told


def test_names_may_hold_delimiters_and_line_ends(tmp_path):
    """As Excel writes a head with a line break in it."""
    text = '"t\n(s)","p, left","Force\r\n[N]","say ""g"""\n0,1,2,3\n1,4,5,6\n'
    found = brought(written(tmp_path, text), "--time", "t", "--stream", "force=force", "--stream", 'q=say "g":V')
    np.testing.assert_array_equal(found["force"][:, 0], [2, 5])
    np.testing.assert_array_equal(found["q"][:, 0], [3, 6])


def test_a_quoted_cell_of_several_lines_does_not_shift_the_line_numbers(tmp_path, monkeypatch):
    """The note of the second row runs over three lines, across the end of a block."""
    monkeypatch.setattr("calib.session.importers.formats.csv_tables.BLOCK_CELLS", 6)
    text = 't,f,note\n0,1,a\n1,2,"b\n\n# c\nd"\n2,bad,e\n3,4,f\n'
    table = CsvFile(written(tmp_path, text)).read([0, 1], 0, iter)
    np.testing.assert_array_equal(table.values, [[0, 1], [1, 2], [2, np.nan], [3, 4]])
    assert table.line[2:].tolist() == [7, 8]


def test_the_line_for_excel_names_no_column(tmp_path):
    found = brought(written(tmp_path, "sep=;\nt;f\n0;1,5\n1;2,5\n"), "--time", "t:s", "--stream", "force=f:N")
    np.testing.assert_array_equal(found["force"][:, 0], [1.5, 2.5])


LIES = {
    "fewer names than cells": ("t,f\n0,1,5\n1,2,5\n", "the header has 2 names, the rows have 3 cells"),
    "more names than cells": ("t,p, left,f\n0,1,2\n1,2,3\n", "the header has 4 names, the rows have 3 cells"),
    "two columns of one name": ("t,f,f\n0,1,2\n1,2,3\n", "is the name of columns 1, 2"),
    "two columns that differ in case": ("t,F,f(N)\n0,1,2\n1,2,3\n", "is the name of columns 1, 2"),
    "thousands or decimals": ('t,f\n0,"1,234"\n1,"2,345"\n', "may have a decimal comma or separate thousands"),
    "a comma late": ("t;f\n" + "0;1\n" * 300 + "1;2,5\n", "line 302: '2,5' has a comma where the table has a decimal"),
    "a point late": ("t;f\n" + "0;1,5\n" * 300 + "1;2.500\n", "'2.500' has a point where the table has a decimal"),
    "names that are numbers": ("0,1,2\n0.5,7,8\n1.5,9,10\n", "may be names or readings"),
    "an open quote": ("t,f\n" + "0,1\n" * 9 + '1,"2\n2,3\n3,4\n', "line 11: quotes do not match"),
    "words after a quote": ('t,f\n0,1\n1,"2"x\n2,3\n', "line 3: quotes do not match"),
}


@pytest.mark.parametrize("lie", LIES)
def test_tables_that_could_be_read_in_two_ways_are_refused(lie, tmp_path, capsys):
    text, said = LIES[lie]
    assert said in refusal(capsys, written(tmp_path, text), "--time", "t:s", "--stream", "force=f:N")


def test_the_decimal_sign_can_be_stated(tmp_path, capsys):
    path, words = written(tmp_path, 't,f\n0,"1,234"\n1,"2,345"\n'), ("--time", "t:s", "--stream", "force=f:N")
    assert brought(path, *words, "--decimal", "comma")["force"][:, 0].tolist() == [1.234, 2.345]
    path.with_name("s.h5").unlink()
    assert "has a comma where the table has a decimal point" in refusal(capsys, path, *words, "--decimal", "point")


def test_a_row_of_too_many_cells_is_left_out_and_counted(tmp_path, capsys):
    """Two lines that a serial line has glued together, or a decimal comma without quotes."""
    path = written(tmp_path, "t,f\n0,1\n1,2,7\n2,3\n3,4\n")
    found = brought(path, "--time", "t:s", "--stream", "force=f:N")
    np.testing.assert_array_equal(found["force"][:, 0], [1, 3, 4])
    assert "1 rows without a time left out (first: line 3)" in capsys.readouterr().out


# --- columns -------------------------------------------------------------------------------------

HEADER = "t,s0,s2,s1,s10,a-b,s_1 (V),f"
ROWS = "\n".join(f"{i},0,2,1,10,7,8,{i}" for i in range(3))


@pytest.mark.parametrize(
    ("columns", "values"),
    [
        ("s0-s2", [0, 1, 2]),
        ("s0,s10,1-2", [0, 10, 0, 2]),
        ("a-b", [7]),
        ("s0-s1", [0, 1]),
        ("s10-a-b", [10, 7]),
        ("s2-s10", None),
        ("s2-s0", None),
    ],
)
def test_ranges_of_header_names_are_by_number_not_by_place(columns, values, tmp_path, capsys):
    path = written(tmp_path, f"{HEADER}\n{ROWS}\n")
    words = ("--time", "t:s", "--stream", "force=f:N", "--stream", f"x={columns}:V")
    if values is None:
        assert "columns" in refusal(capsys, path, *words)
    else:
        np.testing.assert_array_equal(brought(path, *words)["x"][0], values)


def test_numbers_in_names_keep_their_zeros(tmp_path):
    path = written(tmp_path, "t,ch08,ch09,ch10,ch11,f\n0,8,9,10,11,0\n1,8,9,10,11,1\n")
    found = brought(path, "--time", "t:s", "--stream", "force=f:N", "--stream", "x=ch08-ch11:V")
    np.testing.assert_array_equal(found["x"], [[8, 9, 10, 11]] * 2)


def test_the_number_of_a_channel_is_no_unit(tmp_path, capsys):
    path = written(tmp_path, "t (s),s_1,f\n0,1,2\n1,2,3\n")
    words = ("--time", "t", "--stream", "force=f:N")
    assert "no unit given" in refusal(capsys, path, *words, "--stream", "x=s_1")


# --- clocks and several files --------------------------------------------------------------------


def test_a_table_without_a_clock_has_the_stated_rate(tmp_path, capsys):
    path = written(tmp_path, "f\n1\n2\n3\n")
    found = brought(path, "--rate", "4", "--start", "2", "--stream", "force=f:N")
    np.testing.assert_array_equal(found["time"], [2_000_000_000, 2_250_000_000, 2_500_000_000])
    path.with_name("s.h5").unlink()
    for words, said in (
        (("--rate", "0"), "--rate 0: not usable"),
        (("--rate", "nan"), "--rate nan: not usable"),
        (("--rate", "4", "--time", "0:s"), "given together with --rate"),
        (("--time", "0:s", "--start", "1"), "is for tables without a clock"),
        ((), "missing, and no --rate"),
    ):
        assert said in refusal(capsys, path, *words, "--stream", "force=0:N")


CLOCK_BESIDE_RATE = {
    "the true rate": ([0, 0.25, 0.5, 0.75], 4, False),
    "in ms": ([0, 250, 500, 750], 4, False),
    "another rate": ([0, 0.25, 0.5, 0.75], 8, True),
    "rows are missing": ([0, 0.25, 0.5, 1.75], 4, True),
    "a number of the row": ([5, 6, 7, 8], 4, False),
    "no clock": ([3, 1, 2, 1], 4, False),
}


@pytest.mark.parametrize("case", CLOCK_BESIDE_RATE)
def test_a_clock_that_contradicts_the_stated_rate_is_noted(case, tmp_path, capsys):
    times, rate, noted = CLOCK_BESIDE_RATE[case]
    path = written(tmp_path, "time,f\n" + "".join(f"{t},{i}\n" for i, t in enumerate(times)))
    brought(path, "--rate", str(rate), "--stream", "force=f:N")
    assert ("column 'time' looks like a clock" in capsys.readouterr().out) == noted


def test_dates_and_times_are_a_clock(tmp_path, capsys):
    rows = [(".250", 1.5), (".500", 2.5), (".750123456", 3.5)]
    text = "when;f\n" + "".join(f"2026-03-29T01:59:59{t}+01:00;{f}\n" for t, f in rows)
    words = ("--time", "when", "--stream", "force=f:N")
    path = written(tmp_path, text.replace(".5\n", ",5\n"))
    found = brought(path, *words)
    np.testing.assert_allclose(found["time"] / 1e9, [0.25, 0.5, 0.750123], atol=1e-6)
    np.testing.assert_array_equal(found["force"][:, 0], [1.5, 2.5, 3.5])
    with open_session(path.with_name("s.h5")) as session:
        assert session.epoch.startswith("2026-03-29T00:59:59")
    assert "warning" not in capsys.readouterr().out
    path = written(tmp_path, text.replace("+01:00", "").replace("T", " "))
    assert len(brought(path, *words)["time"]) == 3
    assert "state no time zone and are read as UTC" in capsys.readouterr().out


def test_dates_are_no_numbers_and_have_no_unit(tmp_path, capsys):
    rows = "".join(f"{i},2026-01-01T00:00:0{i}Z,{i}\n" for i in range(5))
    path = written(tmp_path, "t,when,f\n" + rows)
    force = ("--stream", "force=f:N")
    assert "which have no unit; leave out :ms" in refusal(capsys, path, "--time", "when:ms", *force)
    assert "names a column of dates and times" in refusal(capsys, path, "--time", "t:s", *force, "--stream", "x=1:V")
    mixed = written(tmp_path, "when,f\n" + rows.replace("3Z", "3").replace("0,2", "2").replace(",2026", "2026"))
    mixed.write_text("when,f\n2026-01-01T00:00:00Z,1\n2026-01-01T00:00:01,2\n2026-01-01T00:00:02Z,3\n")
    found = brought(mixed, "--time", "when", *force)
    np.testing.assert_array_equal(found["force"][:, 0], [1, 3])
    assert "1 rows without a time left out (first: line 3)" in capsys.readouterr().out


def test_logs_that_follow_each_other_become_one_recording(tmp_path, capsys):
    """Columns are found by name in each file, and rows after a change of file are flagged."""
    first = written(tmp_path, "t,f,x\n0,1,9\n1,2,9\n", "a.csv")
    second = written(tmp_path, "x,t,f\n9,10,3\n9,11,bad\n9,12,5\n", "b.csv")
    words = ("--time", "t:s", "--stream", "force=f:N")
    found = brought([first, second], *words)
    np.testing.assert_array_equal(found["time"], np.array([0, 1, 10, 11, 12]) * 10**9)
    np.testing.assert_array_equal(found["force"][:, 0], [1, 2, 3, np.nan, 5])
    assert found["status"].tolist() == [0, 0, Status.gap_before, Status.nonfinite, 0]
    said = capsys.readouterr().out
    assert said.index("a.csv: 2 rows") < said.index("b.csv: 3 rows") < said.index("force: force in N, 5 x 1")
    assert "1 cells are not numbers (first: line 3)" in said
    (tmp_path / "s.h5").unlink()
    assert "a.csv: clock: begins at 0 s, and b.csv ends at 12 s" in refusal(capsys, [second, first], *words)
    other = written(tmp_path, "t,f,x\n20,1,9\n21,2,9\n", "c.csv")
    unit = ("--time", "t:s", "--stream", "force=f:N", "--stream", "x=1-2:V")
    wide = written(tmp_path, "t,f(mN)\n30,1\n31,2\n", "d.csv")
    assert "columns" in refusal(capsys, [other, wide], *unit)


def test_clocks_that_start_anew_need_the_pause_between_them(tmp_path, capsys):
    paths = [written(tmp_path, "0,1\n0.5,2\n", name) for name in ("a.csv", "b.csv")]
    words = ("--time", "0:s", "--stream", "force=1:N")
    assert "give --gap SECONDS" in refusal(capsys, paths, *words)
    np.testing.assert_array_equal(brought(paths, *words, "--gap", "2")["time"], np.array([0, 5, 25, 30]) * 10**8)
    (tmp_path / "s.h5").unlink()
    assert "give --gap SECONDS" in refusal(capsys, paths, "--rate", "2", *words[2:])
    unix = [written(tmp_path, f"{1.7e9 + i},1\n{1.7e9 + i + 1},2\n", f"u{i}.csv") for i in (0, 5)]
    assert "says the pause itself" in refusal(capsys, unix, *words, "--gap", "2")
    mixed = ("--from", str(unix[0]), "--time", "0:s", "--stream", "x=1:V")
    assert "one clock counts from 1970" in refusal(capsys, paths[0], *words, *mixed)


# --- bounds --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limit", "said"), [("import_rows", "rows, the limit is 1,000"), ("import_text", "unpacked, the limit is 1,000")]
)
def test_a_packed_file_is_refused_before_it_is_parsed(limit, said, tmp_path, capsys, monkeypatch):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"0,1\n" * 5_000_000, 1))
    monkeypatch.setattr(limits, "current_budget", lambda: replace(Budget(), **{limit: 1000}))
    monkeypatch.setattr(text_files, "lines_of", lambda path: pytest.fail("was parsed"))
    assert said in refusal(capsys, path, "--time", "0:s", "--stream", "force=1:N")


def test_numbers_of_all_files_together_are_limited(tmp_path, capsys, monkeypatch):
    paths = [written(tmp_path, f"{i},1\n{i + 1},2\n{i + 2},3\n", f"{i}.csv") for i in (0, 10, 20)]
    words = ("--time", "0:s", "--stream", "force=1:N")
    brought(paths, *words)
    (tmp_path / "s.h5").unlink()
    monkeypatch.setattr(limits, "current_budget", lambda: replace(Budget(), import_numbers=17))
    told = refusal(capsys, paths, *words)
    assert "20.csv: file: makes, with its 3 rows of 2 columns, 18 numbers in one import, the limit is 17" in told


def test_the_progress_bar_knows_how_many_lines_there_are(tmp_path):
    seen = []

    def watched(steps):
        seen.append(len(steps))
        return steps

    table = CsvFile(written(tmp_path, "t,f\n" + "0,1\n" * 50)).read([0, 1], 0, watched)
    assert seen == [51]
    assert table.values.shape == (50, 2)


def test_what_is_no_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(SessionError, match="is not a regular file"):
        CsvFile(tmp_path / "pipe.csv")


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("time (ms),force", "--time time: read in s, but the header says ms ('time (ms)')"),
        ("time,force (mN)", "--stream force: read in N, but the header says mN ('force (mN)')"),
        ("time (s),force [N]", None),
        ("time,force [mm]", "--stream force: read in N, but the header says mm ('force [mm]')"),
        ("time,force (counts)", None),
        ("time,force_m", None),  # may be the name of a channel
    ],
)
def test_a_header_that_contradicts_the_command_is_named(header, said, tmp_path, capsys):
    path = written(tmp_path, header + "\n" + "".join(f"{i},{i}.5\n" for i in range(9)))
    brought(path, "--time", "time:s", "--stream", "force=1:N" if "_m" in header else "force=force:N")
    text = capsys.readouterr().out
    assert (f"warning: log.csv: {said}" in text) if said else ("header says" not in text)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--time", "t:s"], "times from 1.7e+12 to 1.7e+12 s cannot be kept"),
        (["--rate", "100", "--start", "1e12"], "check --rate, --start"),
        (["--rate", "1e-300"], "check --rate, --start"),
        (["--rate", "1e300"], "cannot be kept in nanoseconds; check --rate, --start"),
        (["--rate", "100", "--start", "nan"], "--start nan: not usable; give a finite number"),
        (["--rate", "100", "--epoch", "0001-01-01T00:00:00+14:00"], "lies outside of the years 1 to 9999 of UTC"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_times_that_no_calendar_has_end_in_one_line(words, said, tmp_path, capsys):
    path = written(tmp_path, "t,force\n" + "".join(f"{1_700_000_000_000 + 10 * k},{k % 7}\n" for k in range(50)))
    line = refusal(capsys, path, *words, "--stream", "force=force:N")
    assert said in line
    assert "above zero" not in line


def test_the_first_year_has_four_digits(tmp_path):
    path = written(tmp_path, "t,force\n" + "".join(f"{k / 100},{k % 7}\n" for k in range(50)))
    brought(path, "--time", "t:s", "--stream", "force=force:N", "--epoch", "0001-01-01T00:00:00Z")
    with open_session(path.with_name("s.h5")) as session:
        assert session.epoch.startswith("0001-01-01T00:00:00")
