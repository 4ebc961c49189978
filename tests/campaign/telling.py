"""Tell a command something, and judge what it answers."""

import contextlib
import io
import json
import re
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from calib.cli import OUT_OF_MEMORY, main

TOLERANCE = 0.01  # of the largest number of an array: what comes out of an honest input, and of one that does no harm


class Answer(NamedTuple):
    """Exit status, standard output, standard error."""

    status: int
    out: str
    err: str

    @property
    def refused(self) -> bool:
        """Whether the input was refused by a line on standard error."""
        return self.status == 2 and self.err.startswith("jaxeit")

    @property
    def findings(self) -> list[dict[str, Any]]:
        """Findings of `check --json` above a note."""
        return [f for f in json.loads(self.out)["findings"] if f["severity"] != "OK"]


class Verdict(NamedTuple):
    """A verdict and the words that it rests on."""

    verdict: str
    words: str = ""


class BrokenError(Exception):
    """A command answered as none may."""


def tell(*words: object) -> Answer:
    """Run one command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main([str(word) for word in words])
        except SystemExit as stop:  # argparse
            status = int(stop.code or 0)
            err = io.StringIO("jaxeit: " + err.getvalue().strip().splitlines()[-1])
    answer = Answer(status, out.getvalue(), err.getvalue().strip())
    if status not in (0, 2) or (status == 2 and not (answer.err or answer.out)) or "\n" in answer.err:
        raise BrokenError(f"status {status}: {answer.err!r}")
    if OUT_OF_MEMORY in answer.err:
        raise BrokenError(answer.err)
    return answer


def said(answer: Answer) -> dict[str, str]:
    """Findings of `check --json` by what they are without numbers: those of an honest input as well are no word."""
    texts = [f"{f['where']}: {f['what']}" for f in answer.findings]
    return {without_numbers(text): text for text in texts}


def lines(answer: Answer) -> dict[str, str]:
    """Lines on standard output, likewise."""
    return {without_numbers(line): line.strip() for line in answer.out.splitlines()}


def without_numbers(text: str) -> str:
    """A text that says the same of other numbers."""
    return re.sub(r"[-+]?[\d.,]*\d", "0", text).strip()


def judged(answer: Answer, known: Collection[str] = (), about: str = "") -> Verdict | None:
    """The verdict of an answer to `check --json`; None: no more was said of what was changed than the `known` findings.

    Args:
        about: a word that each finding about what was changed holds, such as the name of a stream.
    """
    if answer.refused:
        return Verdict("refused", answer.err)
    new = {key: text for key, text in said(answer).items() if key not in known and about in text}
    return Verdict("said", next(iter(new.values()))) if new else None


def same(found: Any, honest: Any, tolerance: float = TOLERANCE) -> bool:
    """Whether two arrays are equal to a tolerance, where the found one has a number; texts are equal or not."""
    if np.asarray(honest).dtype.kind not in "biuf":
        return np.array_equal(found, honest)
    found, honest = np.asarray(found, float), np.asarray(honest, float)
    if found.shape != honest.shape:
        return False
    known = np.isfinite(found)
    scale = np.nanmax(np.abs(honest), initial=0.0)
    return (
        bool((np.abs(found - honest)[known & np.isfinite(honest)] <= tolerance * scale).all())
        and not (known & ~np.isfinite(honest)).any()
    )
