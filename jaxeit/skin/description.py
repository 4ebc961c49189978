"""The hardware as one TOML file: sheet, electrodes, protocol, pads and pressure sensors."""

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ..budget import require
from ..geometry.shapes import Disc, Domain, Polygon, Rectangle
from ..geometry.surfaces import AbstractSurface, Cylinder, Sphere, SurfaceError
from ..messages.kinds import listed, require_kind, stated
from ..notebook import Drawing, card
from ..registry import RegistryError
from ..toml import TomlError, TomlTable, parse_toml, read_text
from .electrodes.base import ELECTRODES, AbstractElectrode
from .patterns import NAMES, named_protocol
from .protocol import Protocol, ProtocolError


class SkinError(ValueError):
    """Hardware that cannot be; the message names the part."""


@dataclass(frozen=True, eq=False)
class Pad:
    """One air-tight pad: its name and its outline, (corners, 2) m, counter-clockwise.

    Raises:
        SkinError: for an outline that is none, such as a shape of the sheet, or that crosses itself.
    """

    name: str
    outline: np.ndarray

    def __post_init__(self) -> None:
        try:
            self.polygon  # noqa: B018 - which refuses what is no outline
        except TypeError:
            raise SkinError(f"pad {self.name!r}: {stated(self.outline)} is not an outline; give {_CORNERS}") from None
        except ValueError as error:
            raise SkinError(f"pad {self.name!r}: {error}") from None
        object.__setattr__(self, "outline", np.asarray(self.outline, float))

    @property
    def polygon(self) -> Polygon:
        """The outline as a shape."""
        return Polygon(self.outline)

    @property
    def area(self) -> float:
        """Area in m^2."""
        return self.polygon.area


_CORNERS = "its corners [[x, y], ...] in m; those of a Rectangle or Polygon are its corner_points"
MAX_OVERLAP = 0.9  # of the smaller of two pads: more is one pad that is listed twice
BOX_POINTS = 40  # along each side of a box that is examined


def _require_apart(pads: Sequence[Pad]) -> None:
    """Refuse pads of one name, and one that lies on another. Pads that overlap in part share the force there.

    Names that differ in spaces alone look the same in tables, and in their heads.
    """
    names = [" ".join(pad.name.split()) for pad in pads]
    if again := [name for name, number in Counter(names).items() if number > 1]:
        raise SkinError(f"{names.count(again[0])} pads have the name {again[0]!r}; give each pad its own")
    for first, second in combinations(pads, 2):
        if (share := pad_overlap(first, second)) > MAX_OVERLAP:
            within = f"{100 * share:.0f} % of pad {first.name!r} or {second.name!r} lie within the other one"
            raise SkinError(f"{within}; correct the corners")


def pad_overlap(first: Pad, second: Pad) -> float:
    """Share of the smaller of two pads that lies within the other, by points on a grid over what their boxes share.

    Example:
        print(je.skin.pad_overlap(*skin.pads))  # 0 for pads side by side
    """
    low = np.maximum(first.outline.min(0), second.outline.min(0))
    high = np.minimum(first.outline.max(0), second.outline.max(0))
    if (high <= low).any():
        return 0.0
    points = _points_in_box(low, high)
    shapes = first.polygon, second.polygon
    common = shapes[0].contains(points) & shapes[1].contains(points)
    return float(common.mean() * np.prod(high - low) / min(shape.area for shape in shapes))


def _points_in_box(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Points (points, 2) m on a grid over the box between two corners."""
    at = (np.arange(BOX_POINTS) + 0.5) / BOX_POINTS
    shares = np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)
    return np.asarray(low + shares * (high - low))


@dataclass(frozen=True)
class PressureSensor:
    """The span of a pad's gage pressure sensor, ``minimum`` to ``maximum``, and its stated ``accuracy``, in Pa."""

    minimum: float = 0.0
    maximum: float = 34474.0
    accuracy: float = 86.0


@dataclass(frozen=True, eq=False)
class Skin:
    """A skin's hardware, without physics or meshes. Two of them are compared by `skin_hash`.

    | meaning                                   | unit           |
    |-------------------------------------------|----------------|
    | name of the skin                          |                |
    | domain: the sheet's flat shape            | m              |
    | sheet_resistance                          | ohm per square |
    | electrodes, in the order of their numbers |                |
    | protocol: one scan                        |                |
    | pads, in the order of pressure channels   |                |
    | pressure_sensor of each pad               | Pa             |
    | surface: shape in space; None: flat       |                |
    | toml: the text of the skin file           |                |

    Raises:
        ProtocolError: for a protocol of more electrodes.
        SkinError: for a sheet that does not conduct, and for pads beside the sheet, of one name or over one another.
        SurfaceError: for a sheet that would lie over itself on its surface.
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

    def __post_init__(self) -> None:
        self.protocol.check(len(self.electrodes))
        if not 0 < self.sheet_resistance < math.inf:
            raise SkinError(f"sheet_resistance is {self.sheet_resistance}; give ohm per square, above zero")
        for pad in self.pads:
            if why := _misfit(pad, self.domain):
                raise SkinError(f"pad {pad.name!r}: {why}")
        _require_apart(self.pads)
        if self.surface is not None:
            self.surface(_rim(self.domain))  # which refuses a sheet that it cannot carry

    def pads_at(self, points: Float[np.ndarray, "points 2"]) -> Bool[np.ndarray, "pads points"]:
        """Whether points of the sheet, m, lie on each pad."""
        inside = [pad.polygon.contains(points) for pad in self.pads]
        return np.reshape(inside, (len(self.pads), len(points))).astype(bool)

    @property
    def electrode_positions(self) -> np.ndarray:
        """Centres of the electrodes in the sheet's flat coordinates, (electrodes, 2) m."""
        return np.array([e.centre(self.domain) for e in self.electrodes])

    @property
    def drawing(self) -> Drawing:
        """The flat sheet with its pads and electrodes, to be drawn on."""
        low, high = self.domain.bounds
        drawing = Drawing(np.array(low), np.array(high))
        for pad in self.pads:
            drawing.polygon(pad.outline, fill=0.08)
        drawing.polygon(_rim(self.domain))
        drawing.dots(self.electrode_positions, (f"electrode {n}" for n in range(len(self.electrodes))))
        return drawing

    def _repr_html_(self) -> str:
        low, high = np.array(self.domain.bounds)
        kinds = Counter(electrode.name for electrode in self.electrodes)
        width, height = 1e3 * (high - low)
        rows = [
            ("sheet", f"{width:.4g} x {height:.4g} mm, {self.sheet_resistance:.4g} ohm per square"),
            ("surface", "flat" if self.surface is None else type(self.surface).__name__.lower()),
            ("electrodes", ", ".join(f"{count} of kind {kind}" for kind, count in kinds.items())),
            ("readings", f"{self.protocol.readings} in {1e3 * self.protocol.frame_time:.3g} ms"),
            ("pads", listed(pad.name for pad in self.pads) or "none"),
        ]
        label = f"Sheet with {len(self.electrodes)} electrodes and {len(self.pads)} pads"
        return card(f"Skin {self.name}", rows, self.drawing.svg(label))


def _rim(domain: Domain) -> np.ndarray:
    """Points around a sheet, with all its corners, (n, 2) m."""
    along = np.append(domain.corners, np.linspace(0, domain.perimeter, 129)[:-1])
    return domain.boundary_point(np.unique(along))


def shipped_skins() -> tuple[str, ...]:
    """Names of the shipped skins, which `load_skin` accepts."""
    files = resources.files(__package__).joinpath("skins").iterdir()
    return tuple(sorted(f.name[:-5] for f in files if f.name.endswith(".toml")))


def load_skin(name_or_path: str | Path) -> Skin:
    """A shipped skin by name, or your own by the path of its TOML file.

    Raises:
        TomlError: naming the file, the key and the reason.
    """
    give = 'one of them, such as je.load_skin("testbed")'
    require_kind(name_or_path, (str, os.PathLike), TomlError, "the name of a shipped skin or a path", give, "load_skin")
    if str(name_or_path) in shipped_skins():
        shipped = resources.files(__package__).joinpath("skins", f"{name_or_path}.toml")
        return parse_skin(shipped.read_text(encoding="utf-8"), str(name_or_path))
    path = Path(name_or_path)
    if not os.path.isfile(path):  # also False for a name that no file can have
        raise TomlError(
            f"{name_or_path}: no such file, and not a shipped skin; shipped are {', '.join(shipped_skins())}"
        )
    return parse_skin(read_text(path), str(path), allow_import=True)


def parse_skin(text: str, source: str = "skin", allow_import: bool = False) -> Skin:
    """A skin from the text of its TOML file.

    Args:
        source: the name used in error messages.
        allow_import: whether the text may name electrodes of your own by an import path, which runs their code.  Do
            not set it for text that a session or calibration file holds.

    Raises:
        TomlError: naming ``source``, the key and the reason.

    Example:
        text = je.load_skin("testbed").toml.replace("radius = 0.003", "radius = 0.004")
        wider = je.skin.parse_skin(text, "testbed with wider bolts")
        print(wider.electrodes[0].radius)  # m
    """
    return parse_toml(text, source, lambda table: _skin(table, text), allow_import)


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
        key, domain = "size", Rectangle(*table.vector("size", 2, "[width, height] in m"))
    elif shape == "disc":
        key, domain = "radius", Disc(table.positive("radius", "a length in m"))
    else:
        key, domain = "vertices", Polygon(table.array("vertices", 2, "corners [[x, y], ...] in m"))
    if (across := np.ptp(domain.bounds, 0).max()) > _MAX_ACROSS:
        raise table.error(key, f"the sheet is {across:g} m across, more than {_MAX_ACROSS:g} m; give lengths in m")
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
    surface = Cylinder(radius, x) if kind == "cylinder" else Sphere(radius, (x, y))
    try:
        surface(_rim(domain))
    except SurfaceError as error:
        raise table.error("radius", str(error)) from None
    return surface


def _electrodes(table: TomlTable, domain: Domain) -> tuple[AbstractElectrode, ...]:
    name = table.get("kind", lambda v: isinstance(v, str), "one of " + ", ".join(f'"{n}"' for n in ELECTRODES))
    try:
        kind = ELECTRODES.find(name, table.allow_import)
    except RegistryError as error:
        raise table.error("kind", str(error)) from None
    electrodes = kind.read(table, domain)
    require("electrodes", len(electrodes), table.where, TomlError)
    table.done()
    return electrodes


def _protocol(table: TomlTable, electrodes: int) -> Protocol:
    current = table.positive("current", "the amplitude in A")
    frequency = table.number("frequency", "Hz, zero or more", 0.0)
    reading_time = table.number("reading_time", "s, zero or more", 1e-5)
    channels = table.count("sense_channels") if table.has("sense_channels") else 1
    if table.has("rows"):
        rows = table.array("rows", 4, "[[drive+, drive-, sense+, sense-], ...]")
        table.done()
        return Protocol(rows, current, frequency, reading_time, sense_channels=channels)
    name = table.get("pattern", lambda v: isinstance(v, str), NAMES)
    table.done()
    try:
        named = named_protocol(name, electrodes, current, frequency, reading_time)
        return replace(named, sense_channels=channels)
    except ProtocolError as error:
        raise table.error("pattern", str(error)) from None


_MAX_ACROSS = 20.0  # m: a larger sheet was given in mm
_MIN_PAD_WIDTH = 1e-3  # of the shorter side of the sheet
_PAD_REACH = 1.0  # of the sheet's width and height: a pad may jut out, but not by a sheet's size


def _pad(table: TomlTable, domain: Domain) -> Pad:
    name = table.get("name", lambda v: isinstance(v, str) and v.strip() != "", "the pad's name as text")
    key = "rectangle" if table.has("rectangle") else "polygon"
    if key == "rectangle":
        x0, y0, x1, y1 = table.vector("rectangle", 4, "[x0, y0, x1, y1] in m")
        if not (x0 < x1 and y0 < y1):
            raise table.error(key, "the second corner must lie right of and above the first")
        outline = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    else:
        corners = "rectangle = [x0, y0, x1, y1] in m, or polygon = [[x, y], ...]"
        outline = Polygon(table.array(key, 2, corners)).corner_points
    table.done()
    pad = Pad(name, outline)
    if why := _misfit(pad, domain):
        raise table.error(key, why)
    return pad


def _misfit(pad: Pad, domain: Domain) -> str:
    """Why a pad cannot be one of a sheet, and what to give; empty if it can."""
    low, high = np.asarray(domain.bounds)
    beyond = np.maximum(low - np.min(pad.outline, 0), np.max(pad.outline, 0) - high)
    if (beyond > _PAD_REACH * (high - low)).any():
        return f"reaches {beyond.max():.3g} m beyond the sheet; give its corners in m"
    if (size := np.ptp(pad.outline, 0).min()) < _MIN_PAD_WIDTH * (high - low).min():
        sides = " x ".join(f"{side:g}" for side in high - low)
        return f"is {size:.3g} m wide, too little for a pad of this sheet of {sides} m; give all lengths in m"
    if not _meets(pad, domain):
        return "no part of the pad lies on the sheet; give its corners in m, from the sheet's origin"
    return ""


def _meets(pad: Pad, domain: Domain) -> bool:
    """Whether a part of the pad lies on the sheet, by points on a grid over its box."""
    points = _points_in_box(pad.outline.min(0), pad.outline.max(0))
    return bool((pad.polygon.contains(points) & domain.contains(points)).any())


def _sensor(table: TomlTable) -> PressureSensor:
    low = table.number("minimum", "Pa", 0.0, least=-math.inf)
    high = table.number("maximum", "Pa", least=-math.inf)
    accuracy = table.number("accuracy", "Pa, zero or more", 0.0)
    if not high > low:
        raise table.error("maximum", f"is {high} Pa, not above the minimum, {low} Pa")
    table.done()
    return PressureSensor(low, high, accuracy)
