"""Join the summaries of campaigns with other seeds, and write the row of the table of hard cases.

    python -m tests.campaign 2000 1 > 1.json
    python -m tests.campaign 2000 2 > 2.json
    python -m tests.campaign.joined 1.json 2.json [--hard-cases docs/hard-cases.md]

prints the joined summary. Rows are written only if no lie was silent and none broke a command.
"""

import argparse
import itertools
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from ..hard_cases import Row, cells_of, document, replace, table

CASE = "a campaign of lies"


def joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """One summary of several; raises ValueError if two of them told the same lies."""
    spans = sorted((part["seed"], part["first"], part["first"] + part["lies"]) for part in parts)
    for (seed, _, end), (other, start, _) in itertools.pairwise(spans):
        if seed == other and start < end:
            raise ValueError(f"lie {start} of seed {seed} was told twice; give campaigns of other seeds")
    families = dict.fromkeys(family for part in parts for family in part["counts"])
    return {
        "seeds": sorted({part["seed"] for part in parts}),
        "lies": sum(part["lies"] for part in parts),
        "total": _sum([part["total"] for part in parts]),
        "counts": {family: _sum([part["counts"].get(family, {}) for part in parts]) for family in families},
        "seconds": round(sum(part["seconds"] for part in parts), 1),
        "slowest": max((part["slowest"] for part in parts), key=lambda r: r["seconds"]),
        "largest": max((part["largest"] for part in parts), key=lambda r: r["grown"]),
        "failures": [failure for part in parts for failure in part["failures"]],
    }


def _sum(counts: list[dict[str, int]]) -> dict[str, int]:
    return dict(sorted(sum(map(Counter, counts), Counter()).items()))


def texts(found: dict[str, Any]) -> tuple[str, str]:
    """What the table of hard cases says of a campaign without failures: its extent, and what users saw."""
    families = ", ".join(f"{sum(c.values()):,} {family}s" for family, c in found["counts"].items())
    total, slowest, largest = found["total"], found["slowest"]["seconds"], found["largest"]["grown"]
    verdicts = f"{total['refused']:,} refused, {total['said']:,} named, {total['harmless']:,} without effect"
    extremes = f"slowest {slowest:.1f} s of the processor, largest growth of memory {largest / 1e6:.0f} MB"
    return f"{found['lies']:,} generated: {families}", f"{verdicts}, none silent; {extremes}"


def write(path: Path, found: dict[str, Any]) -> None:
    """Replace the row of the campaign in the table; raises ValueError for a campaign with failures."""
    if found["failures"]:
        raise ValueError(f"{len(found['failures'])} lies were silent or broke a command; the table is left as it was")
    reached, beyond = texts(found)
    row = cells_of(table([Row(CASE, reached, None, None, None, beyond)]))
    replace(path, document(cells_of(path.read_text(encoding="utf-8")) | row))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.joined")
    parser.add_argument("parts", nargs="+", type=Path)
    parser.add_argument("--hard-cases", type=Path)
    args = parser.parse_args()
    try:
        found = joined([json.loads(path.read_text()) for path in args.parts])
        print(json.dumps(found, indent=1))
        if args.hard_cases:
            write(args.hard_cases, found)
    except ValueError as error:
        sys.exit(str(error))
