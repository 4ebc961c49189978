"""Panels of the page: one pair of axes each, as vector graphics that take the colours of the page, light or dark.

A panel is as wide as a telephone's screen, and the page puts as many side by side as its window has room for.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

import jaxeit as je

from .parts import BLUE, GREEN, MARKS, MM, RED, bare_figure, draw_sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANEL_WIDTH = 3.5  # inches, at which letters of 10 points are as large as those of the page
WIDE_PANEL_WIDTH = 5.0  # inches, of panels of which the page has few
CHART_HEIGHT = 2.6  # inches, of a panel that shows no sheet
LEFT, RIGHT, BAR, BOTTOM, TOP, MARK = 0.72, 0.12, 0.95, 0.5, 0.1, 0.2  # margins, inches: MARK is that of SIMULATED
SHEET_MARGIN = 0.03  # about the sheet, of its longer side
TALLEST = 1.6  # height of a sheet over its width, beyond which it is drawn narrower
RASTER_DPI = 100  # of maps of many cells

THEME = {
    "#000000": "currentColor",
    "#ffffff": "var(--page)",
    RED: "var(--red)",
    GREEN: "var(--green)",
    BLUE: "var(--blue)",
    **{colour: f"var(--mark-{k})" for k, colour in enumerate(MARKS)},
}
"""Colours of figures, and what they are on a page."""


@dataclass(frozen=True)
class FigurePanel:
    """A picture with its title; ``svg`` is an element of HTML with an alternative text of its own."""

    title: str
    svg: str

    def html(self) -> str:
        """The panel as a figure."""
        return f"<figure class='panel'><figcaption>{escape(self.title)}</figcaption>{self.svg}</figure>"


def panel(figure: "Figure", axes: Any, name: str, alt: str = "") -> FigurePanel:
    """The panel of a figure, whose title becomes that of the panel.

    Args:
        name: begins the identifiers within the picture, so that each picture of a page needs its own.
        alt: what it shows; default: its title.
    """
    lines = axes.get_title().replace(r"\$", "$").split("\n")
    title = ", ".join(lines).replace(":, ", ": ")
    axes.set_title("")
    return FigurePanel(title, inline_svg(figure, name, alt or title))


def sheet_axes(
    skin: je.Skin, *, bar: bool = False, simulated: bool = False, width: float = PANEL_WIDTH
) -> tuple["Figure", Any, Any]:
    """A figure whose axes have the proportions of the sheet, with its outline and pads; and axes of a colour bar.

    Returns: the figure, its axes in mm, and the axes of the bar, or None without one.

    Raises:
        ReportError: matplotlib is not installed.
    """
    low, high = np.array(skin.domain.bounds)
    margin = SHEET_MARGIN * float((high - low).max())
    low, high = low - margin, high + margin
    ratio = float((high - low)[1] / (high - low)[0])
    across = width - LEFT - (BAR if bar else RIGHT)
    up = across * min(ratio, TALLEST)
    across, top = up / ratio, TOP + MARK * simulated
    height = BOTTOM + up + top
    figure = panel_figure(width, height, simulated)
    axes = figure.add_axes((LEFT / width, BOTTOM / height, across / width, up / height))
    draw_sheet(axes, skin)
    axes.set(xlim=(low[0] * MM, high[0] * MM), ylim=(low[1] * MM, high[1] * MM))
    beside = (LEFT + across + 0.1) / width
    return figure, axes, figure.add_axes((beside, BOTTOM / height, 0.12 / width, up / height)) if bar else None


def chart_axes(
    *, simulated: bool = False, width: float = PANEL_WIDTH, height: float = CHART_HEIGHT
) -> tuple["Figure", Any]:
    """A figure with one pair of axes.

    Raises:
        ReportError: matplotlib is not installed.
    """
    figure = panel_figure(width, height, simulated)
    top = TOP + MARK * simulated
    box = (LEFT / width, BOTTOM / height, (width - LEFT - RIGHT) / width, (height - BOTTOM - top) / height)
    return figure, figure.add_axes(box)


def panel_figure(width: float, height: float, simulated: bool) -> "Figure":
    """A figure without axes; with the word SIMULATED if it shows simulated data."""
    figure = bare_figure(width, height)
    if simulated:
        figure.text(LEFT / width, 1 - 0.02, "SIMULATED", color=RED, fontsize=8, fontweight="bold", va="top")
    return figure


def share_limits(axes: Sequence[Any]) -> None:
    """Give all axes the limits that hold the contents of each."""
    for name in ("x", "y"):
        limits = np.array([getattr(one, f"get_{name}lim")() for one in axes])
        for one in axes:
            getattr(one, f"set_{name}lim")(limits[:, 0].min(), limits[:, 1].max())


# --- as part of a page -----------------------------------------------------------------------------------------------


def inline_svg(figure: "Figure", name: str, alt: str) -> str:
    """The figure as an element of HTML that is as wide as there is room, in the colours of the page.

    Identifiers are counted, so that the same figure gives the same text, and begin with ``name``, so that several
    pictures share a page.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", transparent=True, dpi=RASTER_DPI, metadata={"Date": None})
    root = ElementTree.fromstring(buffer.getvalue())
    for part in root.iter():
        part.tag = _local(part.tag)
        part.attrib = {_local(key): value for key, value in part.attrib.items()}
        for left_out in [child for child in part if _local(child.tag) in ("metadata", "style")]:
            part.remove(left_out)
    _rename(root, name)
    for part in root.iter():
        if "style" in part.attrib:
            part.attrib["style"] = _themed(part.attrib["style"])
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-label": alt, "fill": "currentColor"}
    return ElementTree.tostring(root, encoding="unicode")


def _local(name: str) -> str:
    return name.rpartition("}")[2]


def _themed(style: str) -> str:
    for colour, variable in THEME.items():
        style = style.replace(colour, variable)
    return style


def _rename(root: ElementTree.Element, name: str) -> None:
    """Count the identifiers that are referred to, and leave the others out."""
    used: dict[str, str] = {}
    for part in root.iter():
        for value in part.attrib.values():
            target = value[1:] if value.startswith("#") else value[5:-1] if value.startswith("url(#") else None
            if target:
                used.setdefault(target, f"{name}-{len(used)}")
    for part in root.iter():
        if part.attrib.get("id") not in used:
            part.attrib.pop("id", None)
        for key, value in part.attrib.items():
            if key == "id":
                part.attrib[key] = used[value]
            elif value.startswith("#") and value[1:] in used:
                part.attrib[key] = f"#{used[value[1:]]}"
            elif value.startswith("url(#"):
                part.attrib[key] = f"url(#{used[value[5:-1]]})"
