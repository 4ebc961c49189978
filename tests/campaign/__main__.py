"""Run a campaign; see the package."""

import argparse
import json
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import numpy as np

from . import calibrations, descriptions, devices, recordings, tables
from .honest import Honest
from .telling import BrokenError, Verdict

FAMILIES = {
    "recording": recordings.lie,
    "description": descriptions.lie,
    "calibration": calibrations.lie,
    "table": tables.lie,
    "device": devices.lie,
}
LONGEST = 10.0  # s of the processor for one lie
HANGS = 300.0  # s by the clock: on a busy machine a process may wait for the processor
MEMORY = 1 << 30  # bytes that one lie may add to the address space; a command that asks for more gets a MemoryError
SHOWN = 200  # failures printed


class TooLongError(BaseException):
    """Not an error that a command could take for one of its own."""


def _stop(number: int, frame: FrameType | None) -> None:
    limit = LONGEST if number == signal.SIGPROF else HANGS
    raise TooLongError(f"over {limit:.0f} s")


def _limit_time(processor: float, clock: float) -> None:
    signal.setitimer(signal.ITIMER_PROF, processor)
    signal.setitimer(signal.ITIMER_REAL, clock)


def peak() -> int:
    """Peak of the memory of this process, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def address_space() -> int:
    """Address space of this process, bytes."""
    return resource.getpagesize() * int(Path("/proc/self/statm").read_text().split()[0])


def told(number: int, seed: int, honest: Honest, folder: Path) -> dict[str, Any]:
    """Tell one lie: its family, name, verdict, words, seconds and growth of memory."""
    rng = np.random.default_rng([seed, number])
    family = list(FAMILIES)[number % len(FAMILIES)]
    before, start, name = peak(), time.process_time(), ""
    _limit_time(LONGEST, HANGS)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (address_space() + MEMORY, hard))
    try:
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            name, verdict = FAMILIES[family](rng, honest, folder)
        numeric = [w for w in heard if issubclass(w.category, RuntimeWarning)]
        if numeric:
            verdict = Verdict("BROKEN", f"{numeric[0].filename}:{numeric[0].lineno}: {numeric[0].message}")
    except BrokenError as error:
        verdict = Verdict("BROKEN", str(error))
    except (Exception, TooLongError) as error:
        frames = traceback.extract_tb(error.__traceback__)
        at = f"{frames[-1].filename}:{frames[-1].lineno}"
        verdict = Verdict("BROKEN", f"{type(error).__name__}: {error} at {at}")
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        _limit_time(0, 0)
        for left in folder.iterdir():
            left.unlink()
    grown = peak() - before
    seconds = round(time.process_time() - start, 3)
    return {"number": number, "family": family, "lie": name, **verdict._asdict(), "seconds": seconds, "grown": grown}


def run(numbers: range, seed: int, root: Path, seconds: float) -> list[dict[str, Any]]:
    """Tell the lies of these numbers, or those of them for which there is time."""
    jax.config.update("jax_enable_x64", True)
    for limit in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(limit, _stop)
    honest, folder = Honest.make(root / "honest"), root / "lies"
    folder.mkdir()
    assert len(honest.maps) == len(honest.short_maps)  # compiled before the first lie is timed
    assert honest.summary
    end, records = time.monotonic() + seconds, []
    for number in numbers:
        if time.monotonic() >= end:
            break
        records.append(told(number, seed, honest, folder))
        if records[-1]["verdict"] in ("SILENT", "BROKEN"):
            print(json.dumps(records[-1]), file=sys.stderr, flush=True)
    return records


def summary(records: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Counts by family and verdict, extremes and failures, and which lies were told."""
    counts = {
        family: dict(sorted(Counter(r["verdict"] for r in records if r["family"] == family).items()))
        for family in FAMILIES
    }
    failures = [r for r in records if r["verdict"] in ("SILENT", "BROKEN")]
    return {
        "seed": seed,
        "first": records[0]["number"],
        "lies": len(records),
        "total": dict(sorted(Counter(r["verdict"] for r in records).items())),
        "counts": counts,
        "seconds": round(sum(r["seconds"] for r in records), 1),
        "slowest": max(records, key=lambda r: r["seconds"]),
        "largest": max(records, key=lambda r: r["grown"]),
        "failures": failures[:SHOWN],
    }


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign")
    parser.add_argument("count", type=int)
    parser.add_argument("seed", type=int)
    parser.add_argument("--first", type=int, default=0, help="number of the first lie")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="tell no further lie after that time")
    parser.add_argument("--only", type=int, help="tell the lie of this number alone")
    return parser.parse_args()


if __name__ == "__main__":
    args = _arguments()
    numbers = range(args.first, args.first + args.count) if args.only is None else range(args.only, args.only + 1)
    with tempfile.TemporaryDirectory() as root:
        records = run(numbers, args.seed, Path(root), args.seconds)
    print(json.dumps(records[0] if args.only is not None else summary(records, args.seed), indent=1))
    sys.exit(any(r["verdict"] in ("SILENT", "BROKEN") for r in records))
