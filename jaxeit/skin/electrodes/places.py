"""Keys that several kinds of electrodes share in a skin file: their places and their contact resistance."""

import numpy as np

from ...budget import require
from ...geometry.shapes import Domain
from ...toml import TomlError, TomlTable

# ohm m^2, or ohm m on the rim: a bolt of 3 mm radius then has 350 megohm, as one that is not connected.
MAX_CONTACT = 1e4
MIN_RADIUS = 1e-4  # of the shorter side of the sheet


def read_positions(table: TomlTable) -> list[tuple[float, float]]:
    """The places of ``positions`` or of the table ``grid``, m."""
    given = table.has("positions")
    if given and table.has("grid"):
        raise table.error("positions", "the electrodes have a grid too; give one of the two")
    rows = table.array("positions", 2, "[[x, y], ...] in m") if given else _grid(table.table("grid"))
    return [(float(x), float(y)) for x, y in rows]


def read_positions_inside(table: TomlTable, domain: Domain) -> list[tuple[float, float]]:
    """The places of ``positions`` or ``grid``, all of them on the sheet, m."""
    positions = read_positions(table)
    outside = ~domain.contains(np.array(positions))
    if outside.any():
        number = int(np.argmax(outside))
        (x0, y0), (x1, y1) = domain.bounds
        sheet = f"which reaches from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) m"
        problem = f"electrode {number} at {positions[number]} m lies outside the sheet, {sheet}"
        if table.has("positions"):
            raise table.error("positions", f"{problem}; give places in m, on the sheet")
        hint = "give pitch and origin in m, or list positions = [[x, y], ...] where the sheet is no rectangle"
        raise table.error("grid", f"{problem}; {hint}")
    return positions


def read_radius(table: TomlTable, key: str, meaning: str, domain: Domain) -> float:
    """A radius of electrodes on the sheet, m; one of a ten-thousandth of the sheet's width was given in km."""
    radius, width = table.positive(key, meaning), float(np.ptp(domain.bounds, 0).min())
    if radius < MIN_RADIUS * width:
        raise table.error(key, f"is {radius:g} m, too little for electrodes of a sheet of {width:g} m; give {meaning}")
    return radius


def read_area_contact(table: TomlTable) -> float:
    """The specific contact resistance ``contact``, ohm m^2."""
    return read_contact(table, "ohm m^2")


def read_contact(table: TomlTable, unit: str) -> float:
    """The contact resistance ``contact``, in a unit of ohm."""
    contact = table.number("contact", f"{unit}, zero or more")
    if contact > MAX_CONTACT:
        raise table.error("contact", f"is {contact:g} {unit}, which conducts nothing; give 0 to {MAX_CONTACT:g} {unit}")
    return contact


def _grid(table: TomlTable) -> np.ndarray:
    columns, rows = table.count("columns"), table.count("rows")
    require("electrodes", columns * rows, table.where, TomlError)
    pitch = table.positive("pitch", "a length in m")
    origin = table.vector("origin", 2, "[x, y] of the first electrode in m")
    order = table.choice("order", "snake", "rows", default="rows")
    table.done()
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    if order == "snake":
        x[1::2] = x[1::2, ::-1]
    return np.stack([x.ravel(), y.ravel()], 1) * pitch + origin
