"""Pictures of the tables of docs/hard-cases.md: how lies are noticed, and how long a fault lasts.

python -m benchmarks.hard_case_pictures      # from the page alone
"""

import re
from collections import Counter

from matplotlib.figure import Figure

from calib.report.figures.parts import write_figure

from .figures import BLUE, GREY, ORANGE, panels
from .harness import ROOT

PAGE = ROOT / "docs" / "hard-cases.md"
LIES, FAULTS = ROOT / "docs" / "lies.png", ROOT / "docs" / "faults.png"
PARTS = {"eit": "EIT", "presses": "table of presses"}
"""Parts of a recording that have another name in the pictures than in a message."""

UNITS = {"µs": 1e-6, "ms": 1e-3, "s": 1.0}
DURATION = r"([\d.]+) (µs|ms|s)\b"
LASTS = {
    "fault 1: kill -9 of the recorder": ("recorder killed: last kept frame before", rf"arrived {DURATION}"),
    "fault 2: power cut while recording": ("power cut: lost at most", rf"the last {DURATION} lost"),
    "fault 8: TCP device unplugged and plugged": ("TCP plugged in again: received after", rf"within {DURATION}"),
    "fault 8: serial device unplugged and plugged": ("serial plugged in again: received after", rf"within {DURATION}"),
    "fault 11: the device's clock is set": ("device's clock set: error of times", rf"aligned to {DURATION}"),
    "fault 11: latency of 3 ms of every frame": ("latency of the link, with pings: error", rf"known to {DURATION}"),
    "fault 11: jitter of arrival": ("arrival jitters by 16 ms: error of times", rf"aligned to {DURATION}"),
    "fault 11: frames held back in batches": ("frames in batches of 16 ms: error of times", rf"aligned to {DURATION}"),
}
"""Label of each fault that is drawn, and where its row says how long it lasts."""

Cells = list[str]


def rows(text: str) -> dict[str, Cells]:
    """Cells of each row of the tables, by the case."""
    found = [re.split(r"(?<!\\) \| ", line.strip("| ")) for line in text.splitlines() if line.startswith("| ")]
    return {case: cells for case, *cells in found}


def noticed(cases: dict[str, Cells]) -> dict[str, Counter[str]]:
    """By the part of a recording: how many lies end in an error of `check`, and how many in a warning."""
    found: dict[str, Counter[str]] = {}
    for case, cells in cases.items():
        part = re.match(r"/(?:streams/)?(\w+)", cells[-1])
        if case.startswith("lie: "):
            grade = "error" if "error" in cells[0] else "warning"
            name = PARTS.get(part[1], part[1]) if part else "device"
            found.setdefault(name, Counter())[grade] += 1
    return dict(sorted(found.items(), key=lambda item: item[1].total()))


def picture_of_lies(cases: dict[str, Cells]) -> Figure:
    """Bars of errors and warnings."""
    found = noticed(cases)
    figure, (axes,) = panels(7, 0.6 + 0.36 * len(found), 1, 1)
    before = [0] * len(found)
    for grade, color in (("error", ORANGE), ("warning", BLUE)):
        counts = [part[grade] for part in found.values()]
        axes.barh(list(found), counts, left=before, color=color, label=grade)
        before = [a + b for a, b in zip(before, counts, strict=True)]
    axes.set_xlabel("number of lies in the table below")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right")
    return figure


def seconds(cases: dict[str, Cells]) -> dict[str, float]:
    """How long each fault lasts, s, by its label, the longest last."""
    found = {}
    for case, (label, where) in LASTS.items():
        said = re.search(where, cases[case][-1])
        assert said is not None, case
        found[label] = float(said[1]) * UNITS[said[2]]
    return dict(sorted(found.items(), key=lambda item: item[1]))


def picture_of_faults(cases: dict[str, Cells]) -> Figure:
    """A point for each fault, on a logarithmic axis of time."""
    found = seconds(cases)
    figure, (axes,) = panels(7, 0.8 + 0.32 * len(found), 1, 1)
    axes.hlines(list(found), 1e-7, list(found.values()), color="#d0d0d0")
    axes.plot(list(found.values()), list(found), "o", color=BLUE)
    axes.set(xscale="log", xlim=(1e-7, 10), xlabel="time")
    axes.set_xticks([1e-6, 1e-3, 1], ["1 µs", "1 ms", "1 s"])
    axes.minorticks_off()
    axes.grid(True, axis="x", color="#e4e4e4")
    axes.tick_params(axis="y", colors=GREY)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def main() -> None:
    cases = rows(PAGE.read_text(encoding="utf-8"))
    write_figure(picture_of_lies(cases), LIES)
    write_figure(picture_of_faults(cases), FAULTS)


if __name__ == "__main__":
    main()
