"""A skin with another scan or with its electrodes elsewhere, its TOML text changed to match."""

import dataclasses
import re
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from ..toml import TomlError, parse_values
from .description import Skin, parse_skin


def _table(name: str) -> re.Pattern[str]:
    """A table up to the next header, which unlike a row of numbers begins with a letter or a quote."""
    header = rf"^[ \t]*\[[ \t]*{name}[ \t]*\][^\n]*\n"
    return re.compile(rf"""{header}(?P<body>.*?)(?=^[ \t]*\[{{1,2}}[ \t]*["'A-Za-z]|\Z)""", re.M | re.S)


_TABLE, _ELECTRODES, _GRID = _table("protocol"), _table("electrodes"), _table(r"electrodes[ \t]*\.[ \t]*grid")
_ROWS = r"\[(?:[^\[\]#]|#[^\n]*|\[(?:[^\[\]#]|#[^\n]*)*\])*\]"
_KEY = re.compile(rf"""^[ \t]*(?:pattern[ \t]*=[ \t]*["'][^\n"']*["']|rows[ \t]*=[ \t]*{_ROWS})[^\n]*$""", re.M)
_CHANNELS = re.compile(r"^[ \t]*sense_channels[ \t]*=[^\n]*\n", re.M)
SCAN_KEYS = ("pattern", "rows", "sense_channels")
_POSITIONS = re.compile(rf"""^[ \t]*positions[ \t]*=[ \t]*{_ROWS}[^\n]*\n""", re.M)


def with_positions(skin: Skin, positions: Float[Any, "electrodes 2"]) -> Skin:
    """The skin with its electrodes elsewhere; all other lines of its text stay as they are.

    Args:
        skin: from `load_skin`, with its text; its electrodes have ``positions`` or a ``grid``.
        positions: of the electrodes' middles in the sheet's flat coordinates, m, in the order of their numbers; an
            array of NumPy or JAX.

    Raises:
        TomlError: if the skin has no text, its electrodes have no positions, or one would lie outside the sheet.

    Example:
        testbed = je.load_skin("testbed")
        shift = np.zeros((25, 2))
        shift[7] = 1e-3  # m: electrode 7 was drilled 1 mm off in x and in y
        as_drilled = je.skin.with_positions(testbed, testbed.electrode_positions + shift)
        print(as_drilled.toml.count("\\n"), "lines, to be written to a file of its own")
    """
    if np.shape(positions) != (len(skin.electrodes), 2):
        raise TomlError(
            f"{skin.name}: positions have shape {np.shape(positions)}; give two coordinates to each of "
            f"{len(skin.electrodes)} electrodes"
        )
    places = [[round(float(value), 9) for value in place] for place in positions]
    value = "positions = [\n" + "".join(f"    {place},\n" for place in places) + "]\n"
    text = _GRID.sub("", skin.toml)
    table = _ELECTRODES.search(text)
    if table is None:
        raise TomlError(f"{skin.name}: the skin has no text with a table [electrodes]")
    old = _POSITIONS.search(text, *table.span("body"))
    begin, end = old.span() if old else (table.start("body"), table.start("body"))
    text = text[:begin] + value + text[end:]
    before, after = parse_values(skin.toml, skin.name), parse_values(text, skin.name)
    others = {name: given for name, given in before["electrodes"].items() if name not in ("positions", "grid")}
    if len(others) == len(before["electrodes"]) or after != before | {"electrodes": others | {"positions": places}}:
        raise TomlError(
            f"{skin.name}: its electrodes have no positions and no grid that can be replaced in the text; write them "
            "as positions = [[x, y], ...] on lines alone"
        )
    return parse_skin(text, skin.name)


def with_rows(skin: Skin, rows: Integer[np.ndarray, "readings 4"], sense_channels: int | None = None) -> Skin:
    """The skin with other readings; all other lines of its text stay as they are.

    Args:
        skin: from `load_skin`, with its text.
        rows: drive+, drive-, sense+, sense- of each reading, counted from 0.
        sense_channels: readings of one drive that are taken at once; default: as the skin has it.

    Raises:
        ProtocolError: for rows that the skin cannot take.
        TomlError: if the skin has no text, or its text gives the scan in another way than by ``pattern`` or ``rows`` on
            lines of a table ``[protocol]``.
    """
    channels = skin.protocol.sense_channels if sense_channels is None else sense_channels
    protocol = dataclasses.replace(skin.protocol, pattern=rows, mixing=None, sense_channels=channels)
    pattern = protocol.check(len(skin.electrodes)).pattern.tolist()
    lines = [", ".join(map(str, pattern[k : k + 6])) for k in range(0, len(pattern), 6)]
    value = "rows = [  # drive+, drive-, sense+, sense-\n" + "".join(f"    {line},\n" for line in lines) + "]"
    wanted = {"rows": pattern} | ({"sense_channels": channels} if channels > 1 else {})
    value += f"\nsense_channels = {channels}" if channels > 1 else ""
    table = _TABLE.search(skin.toml)
    key = _KEY.search(skin.toml, *table.span("body")) if table else None
    if table is None or key is None:
        raise TomlError(
            f'{skin.name}: the skin has no text with a table [protocol] and lines "pattern" or "rows" in it'
        )
    begin, end = table.span("body")
    ahead, behind = (_CHANNELS.sub("", part) for part in (skin.toml[begin : key.start()], skin.toml[key.end() : end]))
    text = skin.toml[:begin] + ahead + value + behind + skin.toml[end:]
    before, after = parse_values(skin.toml, skin.name), parse_values(text, skin.name)
    scan = {name: given for name, given in before["protocol"].items() if name not in SCAN_KEYS}
    if after != before | {"protocol": scan | wanted}:
        raise TomlError(
            f"{skin.name}: the lines of [protocol] cannot be replaced; write pattern or rows on lines alone"
        )
    return dataclasses.replace(skin, protocol=protocol, toml=text)
