"""A skin with another scan, its TOML text changed to match."""

import dataclasses
import re

import numpy as np
from jaxtyping import Integer

from ..toml import TomlError, parse_values
from .description import Skin

# The [protocol] table up to its next header, which unlike a row of numbers begins with a letter or a quote.
_TABLE = re.compile(
    r"""^[ \t]*\[[ \t]*protocol[ \t]*\][^\n]*\n(?P<body>.*?)(?=^[ \t]*\[{1,2}[ \t]*["'A-Za-z]|\Z)""", re.M | re.S
)
_ROWS = r"\[(?:[^\[\]#]|#[^\n]*|\[(?:[^\[\]#]|#[^\n]*)*\])*\]"
_KEY = re.compile(rf"""^[ \t]*(?:pattern[ \t]*=[ \t]*["'][^\n"']*["']|rows[ \t]*=[ \t]*{_ROWS})[^\n]*$""", re.M)


def with_rows(skin: Skin, rows: Integer[np.ndarray, "readings 4"]) -> Skin:
    """The skin with other readings; all other lines of its text stay as they are.

    Args:
        skin: from `load_skin`, with its text.
        rows: drive+, drive-, sense+, sense- of each reading, counted from 0.

    Raises:
        ProtocolError: for rows that the skin cannot take.
        TomlError: if the skin has no text, or its text gives the scan in another way than by ``pattern`` or ``rows`` on
            lines of a table ``[protocol]``.
    """
    protocol = dataclasses.replace(skin.protocol, pattern=rows, mixing=None).check(len(skin.electrodes))
    pattern = protocol.pattern.tolist()
    lines = [", ".join(map(str, pattern[k : k + 6])) for k in range(0, len(pattern), 6)]
    value = "rows = [  # drive+, drive-, sense+, sense-\n" + "".join(f"    {line},\n" for line in lines) + "]"
    table = _TABLE.search(skin.toml)
    key = _KEY.search(skin.toml, *table.span("body")) if table else None
    if key is None:
        raise TomlError(
            f'{skin.name}: the skin has no text with a table [protocol] and lines "pattern" or "rows" in it'
        )
    text = skin.toml[: key.start()] + value + skin.toml[key.end() :]
    before, after = parse_values(skin.toml, skin.name), parse_values(text, skin.name)
    scan = {name: given for name, given in before["protocol"].items() if name not in ("pattern", "rows")}
    if after != before | {"protocol": scan | {"rows": pattern}}:
        raise TomlError(
            f"{skin.name}: the lines of [protocol] cannot be replaced; write pattern or rows on lines alone"
        )
    return dataclasses.replace(skin, protocol=protocol, toml=text)
