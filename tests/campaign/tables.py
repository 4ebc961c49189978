"""Lies of tables to import: columns, units, clocks, quotes, decimal signs, gaps, rows twice or in another order."""

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from calib.session import open_session
from tests.check.recording import SECOND

from .honest import Honest
from .telling import Answer, Verdict, judged, lines, said, same, tell

Random = np.random.Generator


@dataclass(frozen=True)
class Table:
    """A table as text: header, rows of cells, separator; and the words of the command that imports it."""

    header: list[str]
    rows: list[list[str]]
    comma: str = ","
    time: str = "time:s"
    force: str = "force=force:N"
    pressure: str = "pressure=p0,p1,p2,p3:Pa"
    more: list[str] = field(default_factory=list)

    def text(self) -> str:
        """The file."""
        lines = [self.header, *self.rows] if self.header else self.rows
        return "\n".join(self.comma.join(line) for line in lines) + "\n"


def honest_table(honest: Honest) -> Table:
    """Time, force and pressures of the short recording."""
    force, pressure = honest.short.streams["force"], honest.short.streams["pressure"]
    rows = [
        [f"{t / SECOND:.3f}", f"{f:.4f}", *(f"{p:.2f}" for p in ps)]
        for t, (f,), ps in zip(force.time, force.values, pressure.values, strict=True)
    ]
    return Table(["time", "force", "p0", "p1", "p2", "p3"], rows)


def nothing(t: Table, rng: Random) -> Table:
    """The truth, which must do no harm."""
    return t


# --- lies -------------------------------------------------------------------------------------------------------------


def shuffled_columns(t: Table, rng: Random) -> Table:
    """The columns move with their names."""
    order = rng.permutation(6)
    return replace(t, header=[t.header[i] for i in order], rows=[[row[i] for i in order] for row in t.rows])


def shuffled_by_number(t: Table, rng: Random) -> Table:
    """Columns are named by numbers, and the file has them in another order.

    Not pads alone: which of two pads without names is which, no table tells.
    """
    order = rng.permutation(6)
    order = order[::-1] if (order[:2] == np.arange(2)).all() else order
    rows = [[row[i] for i in order] for row in t.rows]
    numbers = {"time": "0:s", "force": "force=1:N", "pressure": "pressure=2-5:Pa"}
    header = [t.header[i] for i in order] if rng.integers(2) else []
    return replace(t, header=header, rows=rows, **numbers)


def contradicting_unit(t: Table, rng: Random) -> Table:
    """The header states the unit of the numbers, the command another."""
    which = int(rng.integers(3))
    if which == 0:
        rows = [[f"{1e3 * float(row[0]):.0f}", *row[1:]] for row in t.rows]
        return replace(t, header=["time (ms)", *t.header[1:]], rows=rows)
    if which == 1:
        rows = [[row[0], f"{1e3 * float(row[1]):.1f}", *row[2:]] for row in t.rows]
        return replace(t, header=["time", "force (mN)", *t.header[2:]], rows=rows)
    rows = [[*row[:2], *(f"{1e-3 * float(cell):.5f}" for cell in row[2:])] for row in t.rows]
    return replace(t, header=[*t.header[:2], *(f"p{i} [kPa]" for i in range(4))], rows=rows)


def unit_in_header(t: Table, rng: Random) -> Table:
    """The header alone states the unit, and the numbers are in it."""
    rows = [[f"{1e3 * float(r[0]):.0f}", f"{1e3 * float(r[1]):.1f}", *r[2:]] for r in t.rows]
    header = ["time (ms)", "force [mN]", *(f"p{i}_Pa" for i in range(4))]
    return replace(t, header=header, rows=rows, time="time", force="force=force", pressure="pressure=p0-p3")


def wrong_unit(t: Table, rng: Random) -> Table:
    """Forces or pressures in another unit than the command states."""
    column, unit = ((1, "mN"), (1, "kN"), (2, "MPa"), (2, "psi"))[int(rng.integers(4))]
    if column == 1:
        return replace(t, force=f"force=force:{unit}")
    return replace(t, pressure=f"pressure=p0-p3:{unit}")


def decimal_comma(t: Table, rng: Random) -> Table:
    """Decimal commas: in quotes, between semicolons, bare between commas."""
    rows = [[cell.replace(".", ",") for cell in row] for row in t.rows]
    kind = int(rng.integers(3))
    if kind == 0:
        return replace(t, rows=[[f'"{cell}"' for cell in row] for row in rows])
    return replace(t, rows=rows, comma=";" if kind == 1 else ",")


def two_decimal_signs(t: Table, rng: Random) -> Table:
    """The decimal sign changes in the middle."""
    at = int(rng.integers(10, len(t.rows) - 10))
    rows = [[c.replace(".", ",") for c in row] if i >= at else row for i, row in enumerate(t.rows)]
    return replace(t, rows=rows, comma=";")


def thousands(t: Table, rng: Random) -> Table:
    """Digits in groups of three."""
    sign, comma = ((",", ";"), (" ", ","), ("'", ","), ("_", ","))[int(rng.integers(4))]
    rows = [[*row[:2], *(f"{float(c):,.2f}".replace(",", sign) for c in row[2:])] for row in t.rows]
    return replace(t, rows=rows, comma=comma)


def quoted_names(t: Table, rng: Random) -> Table:
    """Header names that hold the separator."""
    header = ['"time"', '"force"', '"p, 0"', '"p, 1"', '"p, 2"', '"p, 3"']
    return replace(t, header=header, pressure='pressure="p, 0","p, 1","p, 2","p, 3":Pa')


def header_again(t: Table, rng: Random) -> Table:
    """The header once more in the middle, with the columns in another order from there."""
    at, order = int(rng.integers(10, len(t.rows) - 10)), [0, 5, 4, 3, 2, 1]
    behind = [[row[i] for i in order] for row in t.rows[at:]]
    return replace(t, rows=[*t.rows[:at], [t.header[i] for i in order], *behind])


def same_name_twice(t: Table, rng: Random) -> Table:
    """Two columns of one name."""
    return replace(t, header=["time", "force", "p0", "p1", "p2", "p0"], pressure="pressure=p0,p1,p2,p0:Pa")


def falling(t: Table, rng: Random) -> Table:
    """All rows in falling order of time."""
    return replace(t, rows=t.rows[::-1], more=[[], ["--sort"]][int(rng.integers(2))])


def shuffled_rows(t: Table, rng: Random) -> Table:
    """Some rows or all in another order."""
    at = int(rng.integers(1, len(t.rows) - 20))
    block = [t.rows[at + i] for i in rng.permutation(20)]
    return replace(t, rows=[*t.rows[:at], *block, *t.rows[at + 20 :]], more=[[], ["--sort"]][int(rng.integers(2))])


def repeated_rows(t: Table, rng: Random) -> Table:
    """Rows twice: each, or a stretch of them."""
    if rng.integers(2):
        return replace(t, rows=[row for row in t.rows for _ in range(2)])
    at = int(rng.integers(1, len(t.rows) - 60))
    return replace(t, rows=[*t.rows[: at + 50], *t.rows[at:]])


def repeated_times(t: Table, rng: Random) -> Table:
    """A clock that stands still for many rows, or counts whole seconds."""
    if rng.integers(2):
        return replace(t, rows=[[str(int(float(row[0]))), *row[1:]] for row in t.rows])
    at = int(rng.integers(1, len(t.rows) - 300))
    return replace(t, rows=[[t.rows[at][0], *r[1:]] if at <= i < at + 250 else r for i, r in enumerate(t.rows)])


def gap(t: Table, rng: Random) -> Table:
    """Rows are missing for seconds."""
    at, size = int(rng.integers(1, len(t.rows) - 200)), int(rng.integers(50, 150))
    return replace(t, rows=t.rows[:at] + t.rows[at + size :])


def cells_missing(t: Table, rng: Random) -> Table:
    """Cells that hold no number: empty, in words, or as a spreadsheet says it."""
    word = ("", "NaN", "#N/A", "-", "null", "ERR", "1e999", "0x1F", "1.2.3", "--", "OVERLOAD")[int(rng.integers(11))]
    rows = [list(row) for row in t.rows]
    for _ in range(int(rng.integers(1, 100))):
        rows[int(rng.integers(len(rows)))][int(rng.integers(1, 6))] = word
    return replace(t, rows=rows)


def ragged(t: Table, rng: Random) -> Table:
    """A row that lacks a cell, or has one more."""
    rows, at = list(t.rows), int(rng.integers(len(t.rows)))
    column = int(rng.integers(6))
    rows[at] = [*rows[at], "7"] if rng.integers(2) else rows[at][:column] + rows[at][column + 1 :]
    return replace(t, rows=rows)


def shifted_cells(t: Table, rng: Random) -> Table:
    """From a row on every column is one further right."""
    at = int(rng.integers(10, len(t.rows) - 10))
    rows = [row if i < at else [row[0], row[5], *row[1:5]] for i, row in enumerate(t.rows)]
    return replace(t, rows=rows)


def footer(t: Table, rng: Random) -> Table:
    """Sums or remarks behind the last row."""
    last = ["end"], ["sum", *["1"] * 5], ["# stopped by operator"], [""], ["", "", "", "", "", ""]
    return replace(t, rows=[*t.rows, last[int(rng.integers(5))]])


def clock_jumps(t: Table, rng: Random) -> Table:
    """The clock restarts in the middle, or wraps."""
    at = int(rng.integers(100, len(t.rows) - 100))
    zero = float(t.rows[at][0])
    return replace(t, rows=[[f"{float(r[0]) - zero:.3f}", *r[1:]] if i >= at else r for i, r in enumerate(t.rows)])


def clock_in_numbers(t: Table, rng: Random) -> Table:
    """A clock of counts or in 5 digits of a float."""
    kind = int(rng.integers(2))
    if kind == 1:
        return replace(t, rows=[[f"{1.7e9 + float(row[0]):.6e}", *row[1:]] for row in t.rows])
    return replace(t, rows=[[f"{1.7e9 + float(row[0]):.3f}", *row[1:]] for row in t.rows])


def clock_of_dates(t: Table, rng: Random) -> Table:
    """Dates and times: true ones, with a unit, in two ways, day before month, or with a time zone that changes."""
    start, kind = datetime(2026, 1, 1, 23, 59, tzinfo=UTC), int(rng.integers(5))
    moments = [start + timedelta(seconds=float(row[0])) for row in t.rows]
    texts = [moment.isoformat() for moment in moments]
    if kind == 2:
        texts[len(texts) // 2 :] = [text.removesuffix("+00:00") for text in texts[len(texts) // 2 :]]
    if kind == 3:
        texts = [f"{moment:%d/%m/%Y %H:%M:%S.%f}" for moment in moments]
    if kind == 4:
        at = int(rng.integers(10, len(texts) - 10))
        texts[at:] = [text.replace("+00:00", "+01:00") for text in texts[at:]]
    return replace(
        t, rows=[[x, *r[1:]] for x, r in zip(texts, t.rows, strict=True)], time="time:s" if kind == 1 else "time"
    )


def stated_rate(t: Table, rng: Random) -> Table:
    """A rate is stated beside a clock that is not used: the true one, another one, or rows are missing."""
    rate, kind = 50.0, int(rng.integers(3))
    if kind == 1:
        rate *= (0.02, 0.1, 0.5, 0.98, 1.02, 2.0, 10.0, 100.0)[int(rng.integers(8))]
    rows = gap(t, rng).rows if kind == 2 else t.rows
    return replace(t, rows=rows, time="", more=["--rate", f"{rate:g}"])


KINDS = (
    nothing, shuffled_columns, shuffled_by_number, contradicting_unit, unit_in_header, wrong_unit, decimal_comma,
    two_decimal_signs, thousands, quoted_names, header_again, same_name_twice, falling, shuffled_rows, repeated_rows,
    repeated_times, gap, cells_missing, ragged, shifted_cells, footer, clock_jumps, clock_in_numbers,
    clock_of_dates, stated_rate,
)  # fmt: skip


def lie(rng: Random, honest: Honest, folder: Path) -> tuple[str, Verdict]:
    """Import the table; what comes out must be what was measured, or `import` or `check` must say something."""
    kind = KINDS[int(rng.integers(len(KINDS)))]
    known = _answers(honest_table(honest), "", honest, folder)
    mark = "\ufeff" if rng.random() < 0.1 else ""
    imported, checked = _answers(kind(honest_table(honest), rng), mark, honest, folder)
    return kind.__name__, _verdict(honest, folder, imported, checked, known)


def _answers(table: Table, mark: str, honest: Honest, folder: Path) -> tuple[Answer, Answer | None]:
    """What `import` and `check` say of a table."""
    path, out = folder / "lie.csv", folder / "out.h5"
    path.write_text(mark + table.text())
    out.unlink(missing_ok=True)
    clock = ("--time", table.time) if table.time else ()
    words = (*clock, "--stream", table.force, "--stream", table.pressure, *table.more)
    imported = tell("import", "csv", path, *words, "-o", out)
    if imported.refused:
        return imported, None
    return imported, tell("check", out, "--skin", honest.folder / "small.toml", "--json")


def _verdict(
    honest: Honest, folder: Path, imported: Answer, checked: Answer | None, known: tuple[Answer, Answer | None]
) -> Verdict:
    if checked is None:
        return Verdict("refused", imported.err)
    same_as_ever = lines(known[0])
    remarks = [text for key, text in lines(imported).items() if key not in same_as_ever]
    if remarks:
        return Verdict("said", remarks[0])
    verdict = judged(checked, said(known[1]))
    if verdict:
        return verdict
    wrong = []
    with open_session(folder / "out.h5") as session:
        for name in ("force", "pressure"):
            found, true = session.stream(name), honest.short.streams[name]
            time, own = np.asarray(found.time), true.time
            if len(time) != len(own) or np.abs((time - time[0]) - (own - own[0])).max() > 2e6:
                wrong.append(f"times of {name}")
            elif not same(found.read(), true.values):
                wrong.append(name)
    text = " / ".join(imported.out.split("\n"))[:300]
    return Verdict("SILENT", f"no word, and {', '.join(wrong)} differ: {text}") if wrong else Verdict("harmless")
