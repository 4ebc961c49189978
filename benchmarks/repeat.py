"""Do two runs agree?  Ratios of times between tools on the same work, each within what the other run's spread allows.

python -m benchmarks.repeat FIRST.json SECOND.json [--sections forward jacobian inverse]

Both files are results/<machine>.json of different runs; or one file and two names of a section, as `--section` of
bench_forward and its kin writes them:  python -m benchmarks.repeat RESULTS.json --sections forward forward-again
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

OURS = "jaxeit float64"
SECTIONS = ("forward", "jacobian", "inverse", "pipeline")

Row = Mapping[str, Any]


class Ratio(NamedTuple):
    """Of medians, and the range that least and most times of both tools allow."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"

    def allows(self, other: "Ratio") -> bool:
        return self.low <= other.value <= self.high


class Comparison(NamedTuple):
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
    ours = {(row["nodes"], _image(row)): row for row in rows if row["tool"].split(",")[0] == OURS}
    for row in rows:
        mine = ours.get((row["nodes"], _image(row)))
        if mine is not None and mine is not row:
            ends = (("median", "median"), ("min", "max"), ("max", "min"))
            ratio = Ratio(*(row[f"{over}_ms"] / mine[f"{under}_ms"] for over, under in ends))
            yield f"{row['tool']}, {row['nodes']:,} nodes", ratio


def _image(row: Row) -> str:
    return row["tool"].rpartition(", ")[2] if "," in row["tool"] else ""


def compared(first: Sequence[Row], second: Sequence[Row]) -> list[Comparison]:
    """Ratios that both runs have."""
    again = dict(ratios(second))
    return [Comparison(what, one, again[what]) for what, one in ratios(first) if what in again]


def table(found: Sequence[Comparison]) -> str:
    lines = ["| times ours | first run | second run | agree |", "|---|---|---|---|"]
    lines += [f"| {f.what} | {f.first} | {f.second} | {'yes' if f.agrees else 'NO'} |" for f in found]
    agreeing = sum(f.agrees for f in found)
    return "\n".join([*lines, "", f"{agreeing} of {len(found)} ratios agree within the spread of the runs."])


def pairs(files: Sequence[Path], sections: Sequence[str]) -> Iterator[tuple[str, Sequence[Row], Sequence[Row]]]:
    """What is compared: a section of two files, or two sections of one."""
    results = [json.loads(path.read_text(encoding="utf-8")) for path in files]
    if len(files) == 2:
        for name in sections:
            if all(name in one for one in results):
                yield name, results[0][name]["rows"], results[1][name]["rows"]
        return
    if len(sections) != 2 or any(name not in results[0] for name in sections):
        raise SystemExit(f"of one file two sections are compared; {files[0].name} has {', '.join(results[0])}")
    yield " and ".join(sections), results[0][sections[0]]["rows"], results[0][sections[1]]["rows"]


def main(argv: list[str] | None = None) -> int:
    """Status 1 where a ratio does not agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="one or two results")
    parser.add_argument("--sections", nargs="+", default=SECTIONS, help="by default %(default)s")
    args = parser.parse_args(argv)
    if len(args.files) > 2:
        parser.error("give one file or two")
    found = {name: compared(first, second) for name, first, second in pairs(args.files, args.sections)}
    for name, several in found.items():
        print(f"{name}\n\n{table(several)}\n")
    return 0 if all(one.agrees for several in found.values() for one in several) else 1


if __name__ == "__main__":
    sys.exit(main())
