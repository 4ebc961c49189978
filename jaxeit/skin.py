"""The hardware as one TOML file: sheet, electrodes, protocol, pads and pressure sensors."""

import math
import os
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from .domain import Disc, Domain, Polygon, Rectangle
from .electrodes import AbstractElectrode, AreaPatch, BoundaryPatch, PointElectrode, PolygonPatch
from .protocol import Protocol, adjacent
from .surface import AbstractSurface, Cylinder, Sphere
from .toml import TomlError, TomlTable, parse_toml, read_text


@dataclass(frozen=True, eq=False)
class Pad:
    """One air-tight pad: its name and its outline, (corners, 2) m, counter-clockwise."""

    name: str
    outline: np.ndarray

    @property
    def area(self) -> float:
        """In m^2."""
        return Polygon(self.outline).area


@dataclass(frozen=True)
class PressureSensor:
    """The span of a pad's gage pressure sensor and its stated accuracy, in Pa."""

    minimum: float = 0.0
    maximum: float = 34474.0
    accuracy: float = 86.0


@dataclass(frozen=True, eq=False)
class Skin:
    """A skin's hardware.  It knows nothing of physics or meshes.

    | meaning                                   | unit           |
    |-------------------------------------------|----------------|
    | domain: the sheet's flat shape            | m              |
    | sheet_resistance                          | ohm per square |
    | electrodes, in the order of their numbers |                |
    | protocol: one scan                        |                |
    | pads, in the order of pressure channels   |                |
    | surface: its shape in space; None: flat   |                |
    | toml: the text that describes all this    |                |
    """

    name: str
    domain: Domain
    sheet_resistance: float
    electrodes: tuple[AbstractElectrode, ...]
    protocol: Protocol
    pads: tuple[Pad, ...] = ()
    pressure_sensor: PressureSensor = PressureSensor()
    toml: str = ""
    surface: AbstractSurface | None = None

    def __post_init__(self):
        self.protocol.check(len(self.electrodes))

    @property
    def electrode_positions(self) -> np.ndarray:
        """Centres of the electrodes in the sheet's flat coordinates, (electrodes, 2) m."""
        return np.array([e.centre(self.domain) for e in self.electrodes])


def shipped_skins() -> tuple[str, ...]:
    """Names that `load_skin` knows."""
    files = resources.files(__package__).joinpath("skins").iterdir()
    return tuple(sorted(f.name[:-5] for f in files if f.name.endswith(".toml")))


def load_skin(name_or_path: str | Path) -> Skin:
    """A shipped skin by name, or your own by the path of its TOML file.

    Raises:
        TomlError: naming the file, the key and the reason.
    """
    if str(name_or_path) in shipped_skins():
        shipped = resources.files(__package__).joinpath("skins", f"{name_or_path}.toml")
        return parse_skin(shipped.read_text(encoding="utf-8"), str(name_or_path))
    path = Path(name_or_path)
    if not os.path.isfile(path):  # False, too, for a name that no file can have
        raise TomlError(
            f"{name_or_path}: no such file, and not a shipped skin; shipped are {', '.join(shipped_skins())}"
        )
    return parse_skin(read_text(path), str(path))


def parse_skin(text: str, source: str = "skin") -> Skin:
    """A skin from the text of its TOML file; ``source`` is the name used in error messages.

    Raises:
        TomlError: naming ``source``, the key and the reason.
    """
    return parse_toml(text, source, lambda table: _skin(table, text))


def _skin(top: TomlTable, text: str) -> Skin:
    top.choice("format", "jaxeit-skin")
    top.get("version", lambda v: v == 1, "1, the version this jaxeit reads")
    name = top.get("name", lambda v: isinstance(v, str) and v != "", "the skin's name as text")
    domain, sheet_resistance, surface = _sheet(top.table("sheet"))
    electrodes = _electrodes(top.table("electrodes"), domain)
    protocol = _protocol(top.table("protocol"), len(electrodes))
    pads = tuple(_pad(table, domain) for table in top.tables("pads"))
    sensor = PressureSensor()
    if top.has("pressure_sensor"):
        sensor = _sensor(top.table("pressure_sensor"))
    top.done()
    return Skin(name, domain, sheet_resistance, electrodes, protocol, pads, sensor, text, surface)


def _sheet(table: TomlTable) -> tuple[Domain, float, AbstractSurface | None]:
    shape = table.choice("shape", "rectangle", "disc", "polygon")
    domain: Domain
    if shape == "rectangle":
        domain = Rectangle(*table.vector("size", 2, "[width, height] in m"))
    elif shape == "disc":
        domain = Disc(table.positive("radius", "a length in m"))
    else:
        domain = Polygon(table.array("vertices", 2, "corners [[x, y], ...] in m"))
    resistance = table.positive("sheet_resistance", "ohm per square")
    surface = _surface(table.table("surface"), domain) if table.has("surface") else None
    table.done()
    return domain, resistance, surface


def _surface(table: TomlTable, domain: Domain) -> AbstractSurface:
    kind = table.choice("kind", "cylinder", "sphere")
    radius = table.positive("radius", "a length in m")
    table.done()
    (x0, y0), (x1, y1) = domain.bounds
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    return Cylinder(radius, x) if kind == "cylinder" else Sphere(radius, (x, y))


def _electrodes(table: TomlTable, domain: Domain) -> tuple[AbstractElectrode, ...]:
    kind = table.choice("kind", "bolt", "point", "edge", "rectangle", "polygon")
    electrodes: tuple[AbstractElectrode, ...]
    if kind == "edge":
        electrodes = _edge_electrodes(table, domain)
    elif kind == "rectangle":
        electrodes = _rectangles(table, domain)
    elif kind == "polygon":
        electrodes = _polygons(table, domain)
    else:
        positions = _positions(table)
        _require_inside(table, positions, domain)
        if kind == "point":
            electrodes = tuple(PointElectrode(p) for p in positions)
        else:
            radius = table.positive("radius", "the contact radius in m")
            contact = _area_contact(table)
            electrodes = tuple(AreaPatch(p, radius, contact) for p in positions)
    table.done()
    return electrodes


def _positions(table: TomlTable) -> list[tuple[float, float]]:
    given = table.has("positions")
    rows = table.array("positions", 2, "[[x, y], ...] in m") if given else _grid(table.table("grid"))
    return [(float(x), float(y)) for x, y in rows]


def _grid(table: TomlTable) -> np.ndarray:
    columns, rows = table.count("columns"), table.count("rows")
    pitch = table.positive("pitch", "a length in m")
    origin = table.vector("origin", 2, "[x, y] of the first electrode in m")
    order = table.choice("order", "snake", "rows", default="rows")
    table.done()
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    if order == "snake":
        x[1::2] = x[1::2, ::-1]
    return np.stack([x.ravel(), y.ravel()], 1) * pitch + origin


def _require_inside(table: TomlTable, positions: list, domain: Domain) -> None:
    outside = ~domain.contains(np.array(positions))
    if outside.any():
        number = int(np.argmax(outside))
        raise table.error("positions", f"electrode {number} at {positions[number]} m lies outside the sheet")


def _area_contact(table: TomlTable) -> float:
    return table.number("contact", "ohm m^2, zero or more")


def _rectangles(table: TomlTable, domain: Domain) -> tuple[PolygonPatch, ...]:
    positions = _positions(table)
    size = table.vector("size", 2, "[width, height] in m")
    if min(size) <= 0:
        raise table.error("size", f"is {list(size)}; give a width and a height in m, above zero")
    angle = table.number("angle", "the turn counter-clockwise in rad", 0.0, least=-math.inf)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
    along, across = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    turned = corners[:, :1] * along + corners[:, 1:] * across
    return _patches(table, "positions", [Polygon(turned + p) for p in positions], domain)


def _polygons(table: TomlTable, domain: Domain) -> tuple[PolygonPatch, ...]:
    meaning = "[[[x, y], ...], ...], the corners of each electrode in m"
    given = table.get("outlines", lambda v: isinstance(v, list) and v != [] and all(map(_is_outline, v)), meaning)
    return _patches(table, "outlines", [_outline(table, number, v) for number, v in enumerate(given)], domain)


def _is_outline(value: Any) -> bool:
    """Whether a value of a TOML file is rows of two numbers; `Polygon` judges the numbers."""
    rows = value if isinstance(value, list) else [None]
    return all(isinstance(row, list) and len(row) == 2 and all(type(x) in (int, float) for x in row) for row in rows)


def _outline(table: TomlTable, number: int, corners: list) -> Polygon:
    try:
        return Polygon(corners)
    except ValueError as error:
        raise table.error("outlines", f"electrode {number}: {error}") from None


def _patches(table: TomlTable, key: str, outlines: list[Polygon], domain: Domain) -> tuple[PolygonPatch, ...]:
    for number, outline in enumerate(outlines):
        outside = ~domain.contains(outline.corner_points)
        if outside.any():
            corner = outline.corner_points[np.argmax(outside)].round(9).tolist()
            raise table.error(key, f"electrode {number} has a corner at {corner} m, outside the sheet")
    contact = _area_contact(table)
    return tuple(PolygonPatch(outline, contact) for outline in outlines)


def _edge_electrodes(table: TomlTable, domain: Domain) -> tuple[AbstractElectrode, ...]:
    count = table.count("count")
    width = table.positive("width", "a length in m")
    first = table.number("first", "arc length of electrode 0's centre in m", 0.0)
    direction = table.choice("direction", "counter-clockwise", "clockwise", default="counter-clockwise")
    contact = table.number("contact", "the contact impedance in ohm m, zero or more")
    if count * width > domain.perimeter:
        raise table.error("width", f"{count} electrodes of {width} m do not fit along the edge")
    step = domain.perimeter / count * (1 if direction == "counter-clockwise" else -1)
    starts = (first - 0.5 * width + step * np.arange(count)) % domain.perimeter
    return tuple(BoundaryPatch(float(s), float(s + width), contact) for s in starts)


def _protocol(table: TomlTable, electrodes: int) -> Protocol:
    if table.has("rows"):
        rows = table.array("rows", 4, "[[drive+, drive-, sense+, sense-], ...]")
    else:
        table.choice("pattern", "adjacent")
        rows = adjacent(electrodes)
    current = table.positive("current", "the amplitude in A")
    frequency = table.number("frequency", "Hz, zero or more", 0.0)
    reading_time = table.number("reading_time", "s, zero or more", 1e-5)
    table.done()
    return Protocol(rows, current, frequency, reading_time)


def _pad(table: TomlTable, domain: Domain) -> Pad:
    name = table.get("name", lambda v: isinstance(v, str), "the pad's name as text")
    if table.has("rectangle"):
        x0, y0, x1, y1 = table.vector("rectangle", 4, "[x0, y0, x1, y1] in m")
        if not (x0 < x1 and y0 < y1):
            raise table.error("rectangle", "the second corner must lie right of and above the first")
        outline = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    else:
        outline = Polygon(table.array("polygon", 2, "corners [[x, y], ...] in m")).corner_points
    table.done()
    return Pad(name, np.asarray(outline, float))


def _sensor(table: TomlTable) -> PressureSensor:
    low = table.number("minimum", "Pa", 0.0, least=-math.inf)
    high = table.number("maximum", "Pa", least=-math.inf)
    accuracy = table.number("accuracy", "Pa, zero or more", 0.0)
    if not high > low:
        raise table.error("maximum", f"is {high} Pa, not above the minimum, {low} Pa")
    table.done()
    return PressureSensor(low, high, accuracy)
