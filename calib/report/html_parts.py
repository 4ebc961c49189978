"""Parts of an HTML page: tables, numbers as texts, the page's frame and style."""

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

MOST_COLUMNS = 9  # beside each other on a wide screen


def html_table(head: Sequence[str], groups: Mapping[str, Iterable[Sequence[str]]], kind: str = "numbers") -> str:
    """A table of plain texts; groups of rows have an optional heading, and the first column names the row."""
    top = "".join(f"<th scope='col'>{escape(cell)}</th>" for cell in head)
    body = "".join(_group(name, rows, head) for name, rows in groups.items())
    kind = f"{kind} many" if len(head) > MOST_COLUMNS else kind
    return f"<div class='wide'><table class='{kind}'><thead><tr>{top}</tr></thead>\n{body}</table></div>"


def _group(name: str, rows: Iterable[Sequence[str]], head: Sequence[str]) -> str:
    title = f"<tr><th scope='rowgroup' colspan='{len(head)}'>{escape(name)}</th></tr>\n" if name else ""
    return f"<tbody>{title}{''.join(_row(row, head) for row in rows)}</tbody>"


def _row(row: Sequence[str], head: Sequence[str]) -> str:
    """Each cell knows its column, whose name stands above it where the table is narrower than its columns."""
    cells = "".join(
        f'<td data-column="{escape(column)}">{escape(cell)}</td>'
        for cell, column in zip(row[1:], head[1:], strict=True)
    )
    return f"<tr><th scope='row'>{escape(row[0])}</th>{cells}</tr>\n"


PLUS_MINUS = "\u00a0±\u00a0"  # never broken over two lines


def number_text(value: float, digits: int) -> str:
    """A number with this many decimals; a dash if it is not finite."""
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else "—"


def significant_text(value: float, digits: int) -> str:
    """A number with this many significant digits; a dash if it is not finite."""
    return f"{value:.{digits}g}".replace("-", "−") if math.isfinite(value) else "—"


def with_error(value: float, error: float, digits: int) -> str:
    """A value and its standard error, with one more digit if the error would be rounded to zero."""
    shown = number_text(error, digits + (error < 10.0**-digits))
    return f"{number_text(value, digits)}{PLUS_MINUS}{shown}" if math.isfinite(error) else number_text(value, digits)


PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""

STYLE = """
:root { --text: #1b1b1b; --page: #ffffff; --soft: #555555; --line: #cfcfcf; --head: #f1f3f5;
  --warn-text: #7a0c0c; --warn-page: #fdecea; --warn-line: #c62828;
  --red: #c62828; --green: #2e7d32; --blue: #1f5fa8;
  --mark-0: #d9730d; --mark-1: #7b3fa0; --mark-2: #00838f; --mark-3: #6d4c41; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e8e8e8; --page: #16181b; --soft: #b3b3b3; --line: #444a50; --head: #22262b;
    --warn-text: #ffd9d4; --warn-page: #4a1512; --warn-line: #ff6f60;
    --red: #ff6f60; --green: #7fd18a; --blue: #7db7f5;
    --mark-0: #ffb454; --mark-1: #cf9df2; --mark-2: #5fd0da; --mark-3: #c8a79b; } }
body { margin: 0; background: var(--page); color: var(--text);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 90rem; margin: 0 auto; padding: 1.5rem 1rem 3rem; }
p, ul, main > figure > figcaption, .banner { max-width: 62rem; }
h1 { font-size: 1.7rem; margin: 0 0 .8rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; }
.banner { background: var(--warn-page); color: var(--warn-text); border: 2px solid var(--warn-line);
  border-radius: 6px; padding: .6rem 1rem; }
.banner strong { font-size: 1.25rem; letter-spacing: .06em; margin-right: .6rem; }
.small, figcaption { font-size: .9em; color: var(--soft); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .95em; }
th, td { border-bottom: 1px solid var(--line); padding: .35em .8em; text-align: right; vertical-align: top; }
thead th { background: var(--head); font-weight: 600; }
th:first-child { text-align: left; }
tbody th { font-weight: 400; }
th[scope=rowgroup] { font-weight: 600; padding-top: .9em; }
td { overflow-wrap: break-word; }
.provenance td, .provenance th { text-align: left; white-space: pre-wrap; }
.provenance td { overflow-wrap: anywhere; font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .9em; }
figure { margin: 0; }
figure + .wide { margin-top: .8rem; }
.panels { display: grid; gap: .8rem 1.2rem; margin-bottom: .5rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 17rem), 1fr)); }
.panel { max-width: 30rem; display: flex; flex-direction: column; justify-content: flex-end; }
.panels.few { grid-template-columns: repeat(auto-fill, minmax(min(100%, 24rem), 1fr)); }
.few > * { max-width: 42rem; }
.panel figcaption { color: var(--text); min-height: 1.5em; }
.panels svg { display: block; width: 100%; height: auto; }
.panels svg * { stroke-linejoin: round; stroke-linecap: butt; }
@media (min-width: 40rem) { .panels.maps { grid-template-columns: repeat(2, minmax(0, 1fr)); } }
@media (min-width: 68rem) { .panels.maps { grid-template-columns: repeat(4, minmax(0, 1fr)); } }
@media screen and (max-width: 48rem) {
STACKED(.numbers) }
STACKED(.many)
li { overflow-wrap: anywhere; }
@media print {
  :root { --text: #000000; --page: #ffffff; --soft: #333333; --line: #999999; --head: #eeeeee;
    --warn-text: #7a0c0c; --warn-page: #ffffff; --warn-line: #c62828; }
  body { font-size: 9.5pt; }
  h1 { font-size: 16pt; }
  h2 { font-size: 12pt; margin-top: 1.2em; }
  table { font-size: .9em; }
  th, td { padding: .25em .6em; }
  main { max-width: none; padding: 0; }
  h2 { break-after: avoid; }
  figure, tr, .banner { break-inside: avoid; }
  .panels { grid-template-columns: repeat(3, 1fr); }
  .wide { overflow: visible; } }
"""

# A table whose rows are blocks of named values, as many beside each other as there is room for.
_STACKED = """
  {0} thead {{ position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }}
  {0}, {0} tbody {{ display: block; }}
  {0} tr {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(9rem, 1fr)); padding: .4rem 0;
    border-bottom: 1px solid var(--line); }}
  {0} th, {0} td {{ border: 0; padding: .1rem 1rem .1rem 0; text-align: left; }}
  {0} th {{ grid-column: 1 / -1; font-weight: 600; overflow-wrap: anywhere; }}
  {0} td:empty {{ display: none; }}
  {0} td::before {{ content: attr(data-column); display: block; color: var(--soft); font-size: .85em; }}"""
STYLE = STYLE.replace("STACKED(.numbers)", _STACKED.format(".numbers")).replace(
    "STACKED(.many)", _STACKED.format(".many")
)
