"""Parts of an HTML page: tables, numbers as texts, the page's frame and style."""

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape


def html_table(head: Sequence[str], groups: Mapping[str, Iterable[Sequence[str]]], kind: str = "numbers") -> str:
    """A table of plain texts; groups of rows have an optional heading, and the first column names the row."""
    top = "".join(f"<th scope='col'>{escape(cell)}</th>" for cell in head)
    body = "".join(_group(name, rows, len(head)) for name, rows in groups.items())
    return f"<div class='wide'><table class='{kind}'><thead><tr>{top}</tr></thead>\n{body}</table></div>"


def _group(name: str, rows: Iterable[Sequence[str]], columns: int) -> str:
    title = f"<tr><th scope='rowgroup' colspan='{columns}'>{escape(name)}</th></tr>\n" if name else ""
    body = "".join(
        f"<tr><th scope='row'>{escape(first)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in rest)}</tr>\n"
        for first, *rest in rows
    )
    return f"<tbody>{title}{body}</tbody>"


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
  --warn-text: #7a0c0c; --warn-page: #fdecea; --warn-line: #c62828; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e8e8e8; --page: #16181b; --soft: #b3b3b3; --line: #444a50; --head: #22262b;
    --warn-text: #ffd9d4; --warn-page: #4a1512; --warn-line: #ff6f60; }
  figure img { filter: brightness(.92); } }
body { margin: 0; background: var(--page); color: var(--text);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 1.5rem 1rem 3rem; }
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
figure img { display: block; width: 100%; height: auto; background: #ffffff; border: 1px solid var(--line);
  border-radius: 4px; margin-bottom: .5rem; }
figure.single img { max-width: 42rem; }
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
  figure img { filter: none; }
  figure.single img { max-width: 13cm; }
  .wide { overflow: visible; } }
"""
