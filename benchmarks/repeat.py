"""Do two runs agree?  Ratios of times between tools on the same work, each within what the other run's spread allows.

python -m benchmarks.repeat FIRST.json SECOND.json [SECTION ...]

Both files are results/<machine>.json of different runs.  Exit status 1 where a ratio does not agree.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from .markdown import markdown
from .rows import Row

OURS = "jaxeit float64"
SECTIONS = ("forward", "jacobian", "inverse", "pipeline")


class Ratio(NamedTuple):
    """Of medians, and the range that least and most times of both tools allow."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"

    def allows(self, other: "Ratio") -> bool:
        return self.low <= other.value <= self.high


class Agreement(NamedTuple):
    """One ratio, other tool over ours, in two runs."""

    what: str
    first: Ratio
    second: Ratio

    @property
    def agrees(self) -> bool:
        """Each run's ratio lies within the other's range."""
        return self.first.allows(self.second) and self.second.allows(self.first)


def ratios(rows: Sequence[Row]) -> Iterator[tuple[str, Ratio]]:
    """Every tool over our float64 one on the same work: as many nodes, and onto the same image."""
    ours = {(r["nodes"], _image(r)): r for r in rows if r["tool"] in (OURS, f"{OURS}, {_image(r)}")}
    for row in rows:
        mine = ours.get((row["nodes"], _image(row)))
        if mine is not None and mine is not row:
            ends = (("median", "median"), ("min", "max"), ("max", "min"))
            ratio = Ratio(*(row[f"{over}_ms"] / mine[f"{under}_ms"] for over, under in ends))
            yield f"{row['tool']}, {row['nodes']:,} nodes", ratio


def _image(row: Row) -> str:
    end = row["tool"].rpartition(", ")[2]
    return end if end in ("pixels", "elements") else ""


def compared(first: Sequence[Row], second: Sequence[Row]) -> list[Agreement]:
    """Ratios that both runs have."""
    again = dict(ratios(second))
    return [Agreement(what, one, again[what]) for what, one in ratios(first) if what in again]


def main(argv: Sequence[str]) -> int:
    first, second = (json.loads(Path(name).read_text(encoding="utf-8")) for name in argv[:2])
    names = [name for name in argv[2:] or SECTIONS if name in first and name in second]
    found = [one for name in names for one in compared(first[name]["rows"], second[name]["rows"])]
    lines = [[one.what, str(one.first), str(one.second), "yes" if one.agrees else "NO"] for one in found]
    print(markdown(["times ours", "first run", "second run", "agree"], lines))
    agreeing = sum(one.agrees for one in found)
    print(f"{agreeing} of {len(found)} ratios agree within the spread of the runs.")
    return 0 if agreeing == len(found) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
