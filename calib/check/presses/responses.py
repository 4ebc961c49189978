"""Check that the readings of EIT respond to the presses."""

from collections.abc import Iterator

import numpy as np

from ..evidence import PressEvidence
from ..report import ChannelTable, Finding, Severity, listed

# A touch changes all readings a little, or a few of them much: quantile of the readings, and how many standard errors
# their changes must exceed there. Chance gives 0.67 and 2.
RESPONSES = ((0.5, 1.2), (0.95, 4.0))


def reading_response_findings(evidence: PressEvidence, table: ChannelTable) -> Iterator[Finding]:
    """Presses in which no reading changes."""
    if evidence.eit is None or not len(evidence.seen):
        return
    good = ~(table.dead | table.empty) & np.isfinite(evidence.eit.mean).all(0)
    changed = np.array([_changes(*row) for row in zip(*_of_readings(evidence, good), strict=True)])
    if changed.all():
        return
    silent = evidence.number[evidence.seen][~changed]
    severity = Severity.ERROR if len(silent) > len(changed) / 2 else Severity.WARNING
    what = f"no reading changes in {len(silent)} of {len(changed)} presses: {listed(silent)}"
    remedy = "check that frames are new ones, that the clocks agree, and that the sheet is pressed"
    yield Finding(severity, "/streams/eit", what, remedy)


def _of_readings(evidence: PressEvidence, good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    assert evidence.eit is not None
    return evidence.eit.mean[:, good], evidence.eit.standard_error[:, good]


def _changes(change: np.ndarray, error: np.ndarray) -> bool:
    """Whether the readings of one press change by more than their noise explains."""
    known = np.isfinite(error) & (error > 0)
    if not known.any():
        return bool((change != 0).any())
    ratio = np.abs(change[known]) / error[known]
    return any(bool(np.quantile(ratio, q) > least) for q, least in RESPONSES)
