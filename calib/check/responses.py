"""Check that the readings and the pads respond to the presses: at all, upwards, and each pad to its own."""

from collections.abc import Iterator

import numpy as np

import jaxeit as je

from .evidence import PressEvidence
from .places import pads_under
from .report import ChannelTable, Finding, Severity, counted, listed

PRESSURE = "/streams/pressure"
# A touch changes all readings a little, or a few of them much: quantile of the readings, and how many standard errors
# their changes must exceed there. Chance gives 0.67 and 2.
RESPONSES = ((0.5, 1.2), (0.95, 4.0))
MIN_PAD_RESPONSE = 0.05  # of the usual change of pressure per newton: a press below it is not felt
MIN_PRESSES_PER_PAD = 3  # from so many presses on, each pad should have been pressed
MIN_FALLING = 2  # presses that all lower the pressure of their pad, from which its sign is wrong
MIN_STRONGER = 3.0  # times its own pad's response: another column that responds so is that pad's


def reading_response_findings(evidence: PressEvidence, table: ChannelTable) -> Iterator[Finding]:
    """Presses in which no reading changes."""
    if evidence.eit is None or not len(evidence.seen):
        return
    good = ~table.dead & np.isfinite(evidence.eit.mean).all(0)
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


def pad_response_findings(evidence: PressEvidence, skin: je.Skin) -> Iterator[Finding]:
    """Pads that do not respond, fall when pressed, or respond to presses on another pad."""
    pressure, force = evidence.pressure, evidence.force
    if pressure is None or pressure.shape[1] != len(skin.pads) or not len(pressure):
        return
    size = np.abs(np.nan_to_num(pressure))
    strongest = size.argmax(1)
    largest = np.take_along_axis(np.nan_to_num(pressure), strongest[:, None], 1)[:, 0]
    if force is not None and np.isfinite(force).all() and (force > 0).all():
        yield from _unfelt_findings(evidence, size.sum(1) / force)
    if (largest < 0).sum() > len(largest) / 2:
        what = f"pressure falls on pressing, in {(largest < 0).sum()} of {len(largest)} presses"
        yield Finding(Severity.ERROR, PRESSURE, what, "negate the columns at import, or exchange the sensor's ports")
        return
    yield from _falling_findings(skin, strongest, largest)
    under = pads_under(skin, evidence.site)
    if under.size:
        yield from _order_findings(skin, under, np.nan_to_num(pressure), strongest)


def _falling_findings(skin: je.Skin, strongest: np.ndarray, largest: np.ndarray) -> Iterator[Finding]:
    """Single columns whose pressure falls whenever they respond most; `largest` (presses,) is their change in Pa."""
    for column, pad in enumerate(skin.pads):
        change = largest[strongest == column]
        clear = np.abs(change) > MIN_PAD_RESPONSE * np.median(np.abs(largest))
        if clear.sum() >= MIN_FALLING and (change[clear] < 0).all():
            what = f"column {column}, pad {pad.name!r}, falls on pressing, in {clear.sum()} of {clear.sum()} presses"
            yield Finding(
                Severity.ERROR, PRESSURE, what, "negate this column at import, or exchange its sensor's ports"
            )


def _unfelt_findings(evidence: PressEvidence, response: np.ndarray) -> Iterator[Finding]:
    """Presses with force that no pad feels; `response` is Pa/N."""
    unfelt = response < MIN_PAD_RESPONSE * np.median(response)
    if unfelt.any():
        rows = evidence.number[unfelt]
        what = f"no pad feels {len(rows)} of {len(response)} presses that have force: {listed(rows)}"
        remedy = "check the tubes of the pads, and that the pressure stream did not stand still"
        yield Finding(Severity.WARNING, PRESSURE, what, remedy)


def _order_findings(skin: je.Skin, under: np.ndarray, pressure: np.ndarray, strongest: np.ndarray) -> Iterator[Finding]:
    """Compare the column that responds with the pad under the tip, pad by pad."""
    alone = np.where(under.sum(0) == 1, under.argmax(0), -1)
    wrong: dict[int, int] = {}
    seen = {*alone.tolist()} - {-1}
    for pad in range(len(skin.pads)):
        rows = np.flatnonzero(alone == pad)
        if not len(rows):
            continue
        change = np.median(pressure[rows], axis=0)
        column = int(change.argmax())
        agreed = (strongest[rows] == column).mean() > 0.5
        if column != pad and agreed and change[column] > MIN_STRONGER * max(change[pad], 0):
            wrong[pad] = column
    # Two pads with one column are no exchange: a tip that slides, or a sensor that fails, looks so.
    if wrong and len({*wrong.values()} | (seen - {*wrong})) == len(seen):
        some = "; ".join(f"column {c} responds over pad {skin.pads[p].name!r}" for p, c in list(wrong.items())[:4])
        pads = counted(len(wrong), "pad")
        what = f"another column than that of the pad under the tip responds, over {pads} of {len(skin.pads)}: {some}"
        remedy = "reorder the columns or the pads of the skin, or check whether x and y are exchanged"
        yield Finding(Severity.ERROR, PRESSURE, what, remedy)
    idle = [skin.pads[p].name for p in range(len(skin.pads)) if not (alone == p).any()]
    if idle and len(alone) >= MIN_PRESSES_PER_PAD * len(skin.pads):
        what = f"none of {len(alone)} presses lies on {counted(len(idle), 'pad')} of {len(skin.pads)}: {listed(idle)}"
        remedy = "press it away from its neighbours: its curve cannot be fitted"
        yield Finding(Severity.WARNING, "/presses", what, remedy)
