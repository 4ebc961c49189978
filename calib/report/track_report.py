"""The report of a recording: contacts that were followed, and what touched the skin in each window."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

import jaxeit as je

from ..calibration.application.map_files import FORCE_MAP_FORMAT, LOADS, TRACKS
from ..calibration.localisation import load_windows
from ..calibration.localisation.contact_tracks import TRACK_ARRAYS, Rows
from ..calibration.localisation.ellipses import INSIDE_90, confidence_ellipse
from ..session import open_archive, replacing
from .example_contacts import ELLIPSE_MAGNIFICATION
from .figures.force_series import SERIES
from .figures.panels import WIDE_PANEL_WIDTH, FigurePanel, chart_axes, panel, sheet_axes
from .figures.parts import MM, require_matplotlib
from .html_parts import PAGE, STYLE, html_table, number_text, with_error
from .load_report import load_parts

ELLIPSES = 5  # of a contact, where it presses with at least half of its largest force
MOST_POINTS = 2000  # of a contact's line
CAPTION = (
    "Paths of the contacts, each with its number where it begins and a dot where it ends; an edge is a line. Ellipses "
    f"of 90 %, drawn {ELLIPSE_MAGNIFICATION} times larger, where a contact presses with at least half of its largest "
    "force. Beside them the forces, with two standard errors on either side."
)


def write_track_report(path: str | Path, forces: str | Path, skin: je.Skin) -> Path:
    """Write a page about the contacts that `calib.apply` followed and the loads that it told, whole or not at all.

    Args:
        path: of the page.
        forces: file of force maps with contacts that were followed, with loads in windows, or both.
        skin: that was touched.

    Raises:
        ReportError: matplotlib is not installed.
        SessionError, OSError: a file cannot be read or written.
    """
    require_matplotlib()
    page = Path(path)
    with open_archive(forces, FORCE_MAP_FORMAT) as archive:
        attrs, known = archive.attrs, archive.arrays
        rows = {name: known[TRACKS + name].read() for name in TRACK_ARRAYS if TRACKS + name in known}
        loads = {name: known[LOADS + name].read() for name in load_windows.LOAD_ARRAYS if LOADS + name in known}
        where = LOADS + load_windows.LEARNED
        learned = [str(line) for line in known[where].read()] if where in known else []
        told = load_parts(loads, learned, simulated=bool(attrs["simulated"]))
    text = _page(rows, told, attrs, skin)
    with replacing(page) as temporary:
        temporary.write_bytes(text.encode())
    return page


def _page(rows: Rows, told: list[str], attrs: Mapping[str, Any], skin: je.Skin) -> str:
    simulated = bool(attrs["simulated"])
    title = f"Contacts in {attrs['session']}"
    parts = [f"<h1>{escape(title)}</h1>"]
    if simulated:
        parts.append('<p class="banner" role="note"><strong>SIMULATED</strong> The recording is simulated.</p>')
    noted = "\n".join(str(attrs.get(name, "")) for name in ("warnings", "outside"))
    parts += [f"<p>Note: {escape(line)}</p>" for line in noted.split("\n") if line]
    if not rows or not len(rows["time"]):
        parts += [] if told else ["<p>No contact was followed.</p>"]
    else:
        panels = "".join(panel.html() for panel in tracks_panels(rows, skin, simulated=simulated))
        alt = "Paths of contacts over the sheet, and their forces over time"
        shown = f"<div class='panels few' role='group' aria-label='{alt}'>{panels}</div>"
        parts += [f"<figure>{shown}<figcaption>{escape(CAPTION)}</figcaption></figure>", _table(rows)]
    parts += told
    mark = "SIMULATED: " if simulated else ""
    return PAGE.format(title=escape(mark + title), style=STYLE, body="\n".join(parts))


def _table(rows: Rows) -> str:
    """When each contact began and ended, where, and how hard it pressed at most."""
    head = ["contact", "from, s", "to, s", "begins at, mm", "ends at, mm", "largest force, N", "speed at most, mm/s"]
    return f"<h2>Contacts</h2>{html_table(head, {'': [_row(number, one) for number, one in by_number(rows).items()]})}"


def _row(number: int, one: Rows) -> tuple[str, ...]:
    time, largest = one["time"] / 1e9, int(np.argmax(one["force"]))
    places = (", ".join(number_text(x * MM, 1) for x in one["position"][k]) for k in (0, -1))
    return (
        str(number),
        number_text(time[0], 2),
        number_text(time[-1], 2),
        *places,
        with_error(float(one["force"][largest]), float(one["force_se"][largest]), 2),
        number_text(float(np.linalg.norm(one["velocity"], axis=1).max()) * MM, 0),
    )


def by_number(rows: Rows) -> dict[int, Rows]:
    """The rows of each contact, by its number."""
    numbers = dict.fromkeys(rows["number"].tolist())
    return {number: {name: part[rows["number"] == number] for name, part in rows.items()} for number in numbers}


def tracks_panels(rows: Rows, skin: je.Skin, *, simulated: bool = False) -> list[FigurePanel]:
    """Paths of contacts over the sheet, with ellipses of 90 %, and their forces over time.

    Args:
        rows: of the contacts, by the names of `TRACK_ARRAYS`.

    Raises:
        ReportError: matplotlib is not installed.
    """
    over_sheet, sheet, _ = sheet_axes(skin, simulated=simulated, width=WIDE_PANEL_WIDTH)
    over_time, forces = chart_axes(simulated=simulated, width=WIDE_PANEL_WIDTH, height=0.8 * WIDE_PANEL_WIDTH)
    limits = sheet.get_xlim(), sheet.get_ylim()
    for k, (number, one) in enumerate(by_number(rows).items()):
        _draw_path(sheet, number, one, SERIES[k % len(SERIES)])
        _draw_force(forces, number, one, SERIES[k % len(SERIES)])
    sheet.set(xlim=limits[0], ylim=limits[1], title="Paths over the sheet")  # also where an ellipse is larger
    forces.set(xlabel="time, s", ylabel="force, N", title="Forces over time")
    forces.set_ylim(bottom=0)
    forces.grid(alpha=0.25)
    return [panel(over_sheet, sheet, "paths"), panel(over_time, forces, "forces")]


def _draw_path(axes: Any, number: int, one: Rows, colour: str) -> None:
    thin = _thinned(len(one["time"]), MOST_POINTS)
    place = one["position"] * MM
    axes.plot(*place[thin].T, color=colour, lw=1.4, zorder=4)
    axes.plot(*place[-1], "o", ms=3, color=colour, zorder=5)
    axes.annotate(str(number), place[0], xytext=(4, 4), textcoords="offset points", color=colour, fontsize=9)
    pressing = np.flatnonzero(one["force"] >= one["force"].max() / 2)
    for at in pressing[_thinned(len(pressing), ELLIPSES)]:
        ellipse = (
            confidence_ellipse(one["position"][at], one["position_covariance"][at], ELLIPSE_MAGNIFICATION * INSIDE_90)
            * MM
        )
        axes.plot(*ellipse.T, color=colour, lw=0.7, alpha=0.8)
        ends = place[at] + np.outer([-1, 1], one["half"][at] * MM)
        axes.plot(*ends.T, color=colour, lw=2.4, alpha=0.5)


def _draw_force(axes: Any, number: int, one: Rows, colour: str) -> None:
    thin = _thinned(len(one["time"]), MOST_POINTS)
    time, force, error = (one[name][thin] for name in ("time", "force", "force_se"))
    axes.fill_between(time / 1e9, force - 2 * error, force + 2 * error, color=colour, alpha=0.2, lw=0)
    axes.plot(time / 1e9, force, color=colour, lw=1.3)
    top = int(np.argmax(force))
    axes.annotate(str(number), (time[top] / 1e9, force[top]), xytext=(0, 4), textcoords="offset points", color=colour)


def _thinned(count: int, most: int) -> np.ndarray:
    """At most so many of `count` rows, evenly, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
