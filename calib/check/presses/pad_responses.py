"""Check that the pads respond to the presses: upwards, each pad to its own, and all of them alike."""

from collections.abc import Iterator

import numpy as np

import jaxeit as je

from ...presses.skins import rests_on_pads
from ..evidence import PressEvidence
from ..parts import flagged_part
from ..report import Finding, Severity, counted, listed
from .places import pads_under

PRESSURE = "/streams/pressure"
MIN_PAD_RESPONSE = 0.05  # of the usual change of pressure per newton: a press below it is not felt
MAX_BESIDE = 0.5  # of the usual response of all pads: less is what pads beside the pressed one bear
# Rows by which pressures may be late as a whole; and presses that tell it, the share of them that agrees then, and by
# how much more agree than as listed.
MAX_LATE_ROWS, MIN_LATE_PRESSES, MIN_LATE_SHARE, MIN_LATE_GAIN = 5, 8, 0.9, 0.15
MIN_PRESSES_PER_PAD = 3  # from so many presses on, each pad should have been pressed
MIN_PRESSES = 2  # on one pad, from which its sign or its scale is known
MIN_STRONGER = 3.0  # times its own pad's response: another column that responds so is that pad's
# Of the pressure that one pad takes for a force, over that of the others. Simulated pads differ by 1.3 at most.
SCALE_RATIO_RANGE = 0.25, 4.0


def pad_response_findings(evidence: PressEvidence, skin: je.Skin, start: int) -> Iterator[Finding]:
    """Pads that do not respond, fall when pressed, read in another unit, or respond to presses on another pad.

    ``start`` is the time at which the recording starts, ns.
    """
    pressure, force = evidence.pressure, evidence.force
    if pressure is None or pressure.shape[1] != len(skin.pads) or not len(pressure):
        return
    size = np.abs(np.nan_to_num(pressure))
    strongest = size.argmax(1)
    largest = np.take_along_axis(np.nan_to_num(pressure), strongest[:, None], 1)[:, 0]
    under = pads_under(skin, evidence.site)
    alone = np.where(under.sum(0) == 1, under.argmax(0), -1) if under.size else np.full(len(pressure), -1)
    same = _equal_columns(pressure)
    if same:
        what = f"columns hold the same values: {listed(f'{a} and {b}' for a, b in same)}"
        remedy = "check which columns were imported, and the addresses of the sensors"
        yield Finding(Severity.ERROR, PRESSURE, what, remedy)
        return
    if force is not None and np.isfinite(force).all() and (force > 0).all():
        scaled = _scaled_pads(size * np.array([pad.area for pad in skin.pads]) / force[:, None], alone)
        for pad, factor in scaled.items():
            yield _scale_finding(skin, pad, factor)
        known, response = np.isin(alone, [*scaled]), size / force[:, None]
        beside = ~_on_pads(evidence, skin)
        yield from _beside_findings(evidence, beside)
        unfelt = response.sum(1) < MIN_PAD_RESPONSE * np.median(response.sum(1))
        yield from _unfelt_findings(evidence, unfelt & ~known & ~beside)
        yield from _silent_findings(evidence, skin, response, np.where(known, -1, alone), unfelt)
    falling = [*_falling_findings(evidence, skin, strongest, largest, start)]
    yield from falling
    late = [] if falling else [*_late_findings(evidence, alone, size)]
    yield from late
    if under.size and not falling and not late:
        yield from _order_findings(evidence, skin, alone, np.nan_to_num(pressure), strongest, start)
        yield from _idle_findings(skin, alone)


def _falling_findings(
    evidence: PressEvidence, skin: je.Skin, strongest: np.ndarray, largest: np.ndarray, start: int
) -> Iterator[Finding]:
    """Columns whose pressure falls whenever they respond most; `largest` (presses,) is their change in Pa."""
    clear = np.abs(largest) > MIN_PAD_RESPONSE * np.median(np.abs(largest))
    down = clear & (largest < 0)
    seen = [c for c in range(len(skin.pads)) if (clear & (strongest == c)).sum() >= MIN_PRESSES]
    always = [c for c in seen if down[clear & (strongest == c)].all()]
    whole = (largest < 0).sum() > len(largest) / 2
    part = flagged_part(down)
    when = "" if part is None else f"; all of them {part.text(evidence.times, start)}"
    if always and always != seen and (down == np.isin(strongest, always) & clear).all():
        for column in always:
            count = (clear & (strongest == column)).sum()
            what = f"column {column}, pad {skin.pads[column].name!r}, falls on pressing, in {count} of {count} presses"
            remedy = "negate this column at import, or exchange its sensor's ports"
            yield Finding(Severity.ERROR, PRESSURE, what + (when if len(always) > 1 else ""), remedy)
    elif whole or part is not None:
        what = f"pressure falls on pressing, in {(largest < 0).sum()} of {len(largest)} presses{when}"
        yield Finding(Severity.ERROR, PRESSURE, what, "negate the columns at import, or exchange the sensor's ports")
    else:
        for column in always:
            count = (clear & (strongest == column)).sum()
            what = f"column {column}, pad {skin.pads[column].name!r}, falls on pressing, in {count} of {count} presses"
            remedy = "negate this column at import, or exchange its sensor's ports"
            yield Finding(Severity.ERROR, PRESSURE, what, remedy)


def _equal_columns(pressure: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of columns that change alike in all presses, to the last digit."""
    columns = range(pressure.shape[1])
    alive = [c for c in columns if np.nan_to_num(pressure[:, c]).any()]
    return [(a, b) for a in alive for b in alive if a < b and np.array_equal(pressure[:, a], pressure[:, b])]


def _scaled_pads(borne: np.ndarray, alone: np.ndarray) -> dict[int, float]:
    """Pads that read another pressure for the same force than the others, with the factor.

    `borne` (presses, pads) is the force that the pressures bear, over that of the load cell. All pads together bear a
    second contact too, so that their sum tells which pad is wrong; its own pressure tells the factor.
    """
    pads = [p for p in range(borne.shape[1]) if (alone == p).sum() >= MIN_PRESSES]
    if len(pads) < 3:  # of two pads, either may be wrong
        return {}
    whole, own = (
        np.array([np.median(b[alone == p]) for p, b in zip(pads, parts, strict=True)])
        for parts in ([borne.sum(1)] * len(pads), borne.T[pads])
    )
    low, high = SCALE_RATIO_RANGE
    ratio, factor = (level / max(float(np.median(level)), np.finfo(float).tiny) for level in (whole, own))
    return {p: float(factor[i]) for i, p in enumerate(pads) if not low < ratio[i] < high}


def _scale_finding(skin: je.Skin, pad: int, factor: float) -> Finding:
    of_others = "times the pressure that the other pads read for the same force"
    what = f"column {pad}, pad {skin.pads[pad].name!r}, reads {factor:.2g} {of_others}"
    remedy = "check its unit (Pa, kPa, mbar) at import, its gain and its tube"
    return Finding(Severity.WARNING, PRESSURE, what, remedy)


def _on_pads(evidence: PressEvidence, skin: je.Skin) -> np.ndarray:
    """Which presses rest on pads, flags (presses,); all of unknown places."""
    if evidence.site is None:
        return np.ones(len(evidence.number), bool)
    return rests_on_pads(skin, evidence.site, evidence.tip_diameter)


def _beside_findings(evidence: PressEvidence, beside: np.ndarray) -> Iterator[Finding]:
    """Presses whose place lies beside all pads, flags (presses,)."""
    if beside.any():
        what = f"{beside.sum()} of {len(beside)} presses rest on no pad: {listed(evidence.number[beside])}"
        yield Finding(Severity.WARNING, "/presses", what, "they are left out: no pad tells their force; press on pads")


def _unfelt_findings(evidence: PressEvidence, unfelt: np.ndarray) -> Iterator[Finding]:
    """Presses with force that no pad feels, flags (presses,)."""
    if unfelt.any():
        rows = evidence.number[unfelt]
        what = f"no pad feels {len(rows)} of {len(unfelt)} presses that have force: {listed(rows)}"
        remedy = "check the tubes of the pads, and that the pressure stream did not stand still"
        yield Finding(Severity.WARNING, PRESSURE, what, remedy)


def _late_findings(evidence: PressEvidence, alone: np.ndarray, size: np.ndarray) -> Iterator[Finding]:
    """Pressures that fit the presses some rows before or after, as of a stream that is late by a whole press.

    Args:
        alone: pad under the tip, (presses,); -1: none, or several.
        size: of the pressures, (presses, pads) Pa.
    """
    agreed = {rows: _agreement(alone, size, rows) for rows in range(-MAX_LATE_ROWS, MAX_LATE_ROWS + 1)}
    best = max(agreed, key=lambda rows: (agreed[rows], -abs(rows)))
    gained = best and agreed[best] >= MIN_LATE_SHARE and agreed[0] <= agreed[best] - MIN_LATE_GAIN
    if gained and not _arrives(evidence, alone):
        presses = f"{counted(abs(best), 'press', 'presses')} {'late' if best > 0 else 'early'}"
        what = (
            f"the pads respond {presses}: {agreed[best]:.0%} of the presses so moved lie on the pad that responds "
            f"most, and {agreed[0]:.0%} as listed"
        )
        remedy = "compare the clock of the pressures with the others, and move its time stamps at import"
        yield Finding(Severity.ERROR, PRESSURE, what, remedy)


def _arrives(evidence: PressEvidence, alone: np.ndarray) -> bool:
    """Whether the listed pads respond first, as under tips that slide onto other pads; streams that are late do not
    show it."""
    if evidence.arriving is None:
        return False
    return _agreement(alone, np.abs(np.nan_to_num(evidence.arriving())), 0) >= MIN_LATE_SHARE


def _agreement(alone: np.ndarray, size: np.ndarray, rows: int) -> float:
    """Share of the presses that lie on the pad that responds most so many rows later; 0 of few presses or pads."""
    pads_of, read = (alone[: len(alone) - rows], size[rows:]) if rows >= 0 else (alone[-rows:], size[:rows])
    known = pads_of >= 0
    if known.sum() < MIN_LATE_PRESSES or len(np.unique(pads_of[known])) < 2:
        return 0.0
    strongest = np.where(read.max(1) > MIN_PAD_RESPONSE * np.median(size.max(1)), read.argmax(1), -1)
    return float(np.mean(strongest[known] == pads_of[known]))


def _silent_findings(
    evidence: PressEvidence, skin: je.Skin, response: np.ndarray, alone: np.ndarray, unfelt: np.ndarray
) -> Iterator[Finding]:
    """Presses that the pad under the tip does not feel, while it feels others and pads beside it bear little.

    Args:
        response: (presses, pads) Pa/N.
        alone: pad under the tip, (presses,); -1: none, or one that is known to be wrong.
        unfelt: presses that no pad feels, (presses,), of which something else is said.
    """
    whole = response.sum(1)
    weak = whole < MAX_BESIDE * np.median(whole)
    for pad in range(response.shape[1]):
        on, own = alone == pad, response[:, pad]
        silent = on & weak & ~unfelt & (own < MIN_PAD_RESPONSE * _median(own[on & ~weak]))
        if silent.any():
            what = (
                f"column {pad}, pad {skin.pads[pad].name!r}, does not feel {silent.sum()} of {on.sum()} presses on it: "
                f"{listed(evidence.number[silent])}"
            )
            remedy = "check its tube, sensor and plug at that time, and the places of these presses"
            yield Finding(Severity.WARNING, PRESSURE, what, remedy)


def _median(values: np.ndarray) -> float:
    """The median; 0 of nothing."""
    return float(np.median(values)) if len(values) else 0.0


def _order_findings(
    evidence: PressEvidence,
    skin: je.Skin,
    alone: np.ndarray,
    pressure: np.ndarray,
    strongest: np.ndarray,
    start: int,
) -> Iterator[Finding]:
    """Compare the column that responds with the pad under the tip, pad by pad: in all presses, then in a part."""
    wrong, when = _wrong_columns(skin, alone, pressure, strongest), ""
    if not wrong:
        own = np.take_along_axis(pressure, np.clip(alone, 0, None)[:, None], 1)[:, 0]
        most = np.take_along_axis(pressure, strongest[:, None], 1)[:, 0]
        other = (alone >= 0) & (alone != strongest) & (most > MIN_STRONGER * np.maximum(own, 0))
        part = flagged_part(other)
        if part is None:
            return
        some = part.mask(len(alone))
        wrong = _wrong_columns(skin, alone[some], pressure[some], strongest[some])
        when = f" {part.text(evidence.times, start)}"
    if wrong:
        some_pads = "; ".join(f"column {c} responds over pad {skin.pads[p].name!r}" for p, c in [*wrong.items()][:4])
        pads = counted(len(wrong), "pad")
        what = (
            f"another column than that of the pad under the tip responds{when}, over {pads} of {len(skin.pads)}: "
            f"{some_pads}"
        )
        remedy = "reorder the columns or the pads of the skin, or check whether x and y are exchanged"
        yield Finding(Severity.ERROR, PRESSURE, what, remedy)


def _wrong_columns(skin: je.Skin, alone: np.ndarray, pressure: np.ndarray, strongest: np.ndarray) -> dict[int, int]:
    """Pads with the other column that responds over them; empty unless the columns are exchanged with each other."""
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
    return wrong if len({*wrong.values()} | (seen - {*wrong})) == len(seen) else {}


def _idle_findings(skin: je.Skin, alone: np.ndarray) -> Iterator[Finding]:
    """Pads that no press lies on."""
    idle = [skin.pads[p].name for p in range(len(skin.pads)) if not (alone == p).any()]
    if idle and len(alone) >= MIN_PRESSES_PER_PAD * len(skin.pads):
        what = f"none of {len(alone)} presses lies on {counted(len(idle), 'pad')} of {len(skin.pads)}: {listed(idle)}"
        remedy = "press it away from its neighbours: its curve cannot be fitted"
        yield Finding(Severity.WARNING, "/presses", what, remedy)
