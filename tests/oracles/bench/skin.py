"""The skin as its TOML text describes it: a rectangle with round bolts and rectangular pads.

Only what the testbed and the chest need is read; anything else raises `KeyError` or `ValueError`. A sheet that is bent
to a cylinder conducts as it does when flat.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SKINS = Path(__file__).parents[3] / "jaxeit" / "skin" / "skins"
TESTBED, CHEST = SKINS / "testbed.toml", SKINS / "chest.toml"


@dataclass(frozen=True)
class Skin:
    """Geometry and protocol of a skin.

    | meaning                                                                                    |
    |--------------------------------------------------------------------------------------------|
    | text: the TOML text as read; size: width and height of the sheet, m                        |
    | resistance: of the sheet, ohm per square                                                   |
    | bolts: (electrodes, 2) centres, m; radius, m; contact: specific resistance, ohm m^2        |
    | pattern: (readings, 4) drive+, drive-, sense+, sense-; current, A; reading_time, s         |
    | pads: (pads, 4) x0, y0, x1, y1, m                                                          |
    """

    text: str
    name: str
    size: np.ndarray
    resistance: float
    bolts: np.ndarray
    radius: float
    contact: float
    pattern: np.ndarray
    current: float
    reading_time: float
    pads: np.ndarray


def read_skin(path: Path = TESTBED) -> Skin:
    text = path.read_text(encoding="utf-8")
    table = tomllib.loads(text)
    sheet, electrodes, protocol = table["sheet"], table["electrodes"], table["protocol"]
    if (sheet["shape"], electrodes["kind"], protocol["pattern"]) != ("rectangle", "bolt", "adjacent"):
        raise ValueError(f"{path}: this simulator knows rectangles with bolts and the adjacent pattern only")
    if sheet.get("surface", {"kind": "cylinder"})["kind"] != "cylinder":
        raise ValueError(f"{path}: this simulator knows sheets that are flat or bent to a cylinder only")
    bolts = np.array(electrodes["positions"]) if "positions" in electrodes else _grid(**electrodes["grid"])
    return Skin(
        text=text,
        name=table["name"],
        size=np.array(sheet["size"], float),
        resistance=sheet["sheet_resistance"],
        bolts=bolts,
        radius=electrodes["radius"],
        contact=electrodes["contact"],
        pattern=adjacent(len(bolts)),
        current=protocol["current"],
        reading_time=protocol["reading_time"],
        pads=np.array([pad["rectangle"] for pad in table["pads"]], float),
    )


def _grid(columns: int, rows: int, pitch: float, origin: list[float], order: str) -> np.ndarray:
    places = [
        (column if order == "rows" or row % 2 == 0 else columns - 1 - column, row)
        for row in range(rows)
        for column in range(columns)
    ]
    return np.array(origin) + pitch * np.array(places)


def adjacent(count: int) -> np.ndarray:
    """Every neighbour pair (closed to a ring) is driven, and every pair that shares no electrode with it is read."""
    pairs = [(k, (k + 1) % count) for k in range(count)]
    return np.array([d + s for d in pairs for s in _from(pairs, d) if not set(d) & set(s)])


def _from(pairs: list[tuple[int, int]], first: tuple[int, int]) -> list[tuple[int, int]]:
    """The pairs in turn around the ring, beginning with ``first``."""
    start = pairs.index(first)
    return pairs[start:] + pairs[:start]
