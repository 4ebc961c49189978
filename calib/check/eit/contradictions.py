"""Find readings that contradict others of the same frame: their reciprocal readings, or the model of the skin.

Drive and sense of a four-terminal reading may be exchanged without a change of the voltage (Helmholtz's reciprocity),
in any sheet and with any contacts. A reading of the wrong sign or gain therefore differs from its reciprocal one.
"""

from collections.abc import Iterator

import numpy as np

from ..report import ChannelTable, Finding, Severity, listed
from .grouping import common_part, readings_of_electrodes
from .model import SkinModel

WHERE = "/streams/eit"
# Share of the larger of two reciprocal readings, beyond which they contradict each other. Amplifiers of little
# common-mode rejection reach 0.22.
MIN_CONTRADICTION = 0.35
MAX_RECIPROCITY_ERROR = 0.02  # median of all readings
REVERSED = 0.2  # tolerance of a ratio of -1
EQUAL = 0.02  # relative difference of voltages that are the same
MIN_OFFSET = 0.1  # of the root mean square voltage; a common mode and a coat reach 0.013
LOST = 0.1  # of the model's voltage, that the readings of a lost electrode have
MIN_MODEL = 0.1  # of the root mean square voltage of the model, below which a ratio means nothing


def check_reciprocity(table: ChannelTable, model: SkinModel | None, findings: list[Finding]) -> np.ndarray:
    """Readings (readings,) that contradict their reciprocal ones; what is wrong is added to ``findings``."""
    error = table.reciprocity[~table.bad & np.isfinite(table.reciprocity)]
    if len(error) and np.median(error) > MAX_RECIPROCITY_ERROR:
        what = (
            f"reciprocity error: readings differ by {100 * np.median(error):.1f} % (median) when drive "
            "and sense are exchanged, where physics allows no difference"
        )
        remedy = "compare the wiring and the order of the readings with the recorded pattern"
        findings.append(Finding(Severity.WARNING, WHERE, what, remedy))
        return np.zeros(len(table), bool)
    flag = (table.partner >= 0) & (np.nan_to_num(table.reciprocity) > MIN_CONTRADICTION) & ~table.bad
    flag &= flag[table.partner]
    if not flag.any():
        return np.zeros(len(table), bool)
    wrong, common = _wrong_ones(np.asarray(flag), table, model)
    findings += _contradictions(table, wrong, common)
    return wrong


def _contradictions(table: ChannelTable, wrong: np.ndarray, common: str) -> Iterator[Finding]:
    pairs = _exchanged(wrong, table)
    if pairs:
        some = listed((f"{i} and {j}" for i, j in pairs), 4)
        what = f"readings are exchanged with each other, by their reciprocal readings: {some}"
        yield Finding(Severity.WARNING, WHERE, what, "correct the order of the readings, or the rows of the pattern")
        return
    ratio = float(np.median(table.mean[wrong] / table.mean[table.partner[wrong]]))
    reverse = abs(ratio + 1) < REVERSED
    how = "have the opposite sign of" if reverse else f"are {ratio:.2g} times" if wrong.sum() > 1 else "contradict"
    if wrong.sum() == 1:
        how = "has the opposite sign of" if reverse else f"is {ratio:.2g} times"
    rows = np.flatnonzero(wrong)
    subject = f"reading {rows[0]}" if len(rows) == 1 else f"{len(rows)} of {len(table)} readings"
    what = f"{subject}{common} {how} the reading with drive and sense exchanged, where physics allows no difference"
    what += f": {listed(rows)}" if len(rows) > 1 else ""
    wires = "exchange the two inputs (sense+ and sense-, or drive+ and drive-), or correct the sign at import"
    yield Finding(Severity.WARNING, WHERE, what, wires if reverse else "check the gain and the wires of these readings")


def _wrong_ones(flag: np.ndarray, table: ChannelTable, model: SkinModel | None) -> tuple[np.ndarray, str]:
    """Which reading of each contradicting pair is wrong, as far as the model tells; what the wrong ones share."""
    away = _away_from_model(table, model)
    group = common_part(flag, table.partner, table.pattern)
    if group is not None:
        some, words = group
        other = np.zeros_like(some)
        other[table.partner[some]] = True
        if model is None or away[some].sum() >= away[other].sum():
            return some, f", all that {words},"
        return other, f", all that {words.replace('drive', 'sense')},"
    return flag & (away >= away[table.partner]), ""


def _away_from_model(table: ChannelTable, model: SkinModel | None) -> np.ndarray:
    """How far each reading is from the model, as a logarithm; a wrong sign counts for a factor of a thousand."""
    if model is None:
        return np.zeros(len(table))
    expected = model.predict(table)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = table.mean / expected
        ratio = ratio / np.nanmedian(ratio)
        return np.asarray(
            np.nan_to_num(np.abs(np.log(np.abs(ratio))) + np.where(ratio < 0, np.log(1e3), 0.0), posinf=1e3)
        )


def _exchanged(wrong: np.ndarray, table: ChannelTable) -> list[tuple[int, int]]:
    """Pairs of wrong readings that explain all of them if exchanged; empty if there are others."""
    rows = np.flatnonzero(wrong)
    here, due = table.mean[rows], table.mean[table.partner[rows]]
    same = np.abs(here[:, None] - due) < EQUAL * np.fmax(np.abs(here[:, None]), np.abs(due))
    mutual = same & same.T
    np.fill_diagonal(mutual, False)
    if len(rows) < 2 or not mutual.any(1).all():
        return []
    pairs = {tuple(sorted((int(rows[i]), int(rows[mutual[i].argmax()])))) for i in range(len(rows))}
    return sorted((a, b) for a, b in pairs)


def offset_finding(table: ChannelTable, good: np.ndarray, model: SkinModel) -> Finding | None:
    """A voltage that all readings have in addition to what the skin gives."""
    scale, offset = model.scale_and_offset(table.mean, good, table)
    left = table.mean[good] - scale * model.predict(table)[good]
    size = float(np.sqrt(np.mean((table.mean[good] - offset) ** 2)))
    if not (abs(offset) > MIN_OFFSET * size and abs(np.median(left)) > MIN_OFFSET * size):
        return None
    what = (
        f"all readings have {offset:+.3g} V in addition to what the skin gives "
        f"(amplitude {scale:.3g} times the model's)"
    )
    remedy = "remove the offset of the amplifier or the converter: subtract what is read without drive current"
    return Finding(Severity.WARNING, WHERE, what, remedy)


def lost_electrode_findings(table: ChannelTable, model: SkinModel) -> Iterator[Finding]:
    """Electrodes whose readings hold noise instead of the voltage that the model has."""
    expected = np.abs(model.predict(table))
    large = (expected > MIN_MODEL * np.sqrt(np.mean(expected**2))) & np.isfinite(table.mean) & ~table.dead
    ratio = np.abs(table.mean) / np.where(large, expected, 1)
    usual = float(np.median(ratio[large])) if large.any() else 0.0
    weak = large & (ratio < LOST * usual)
    for electrode, uses in enumerate(readings_of_electrodes(table)):
        if (uses & large).sum() > 2 and (weak | ~large)[uses].all():
            what = (
                f"the {uses.sum()} readings of electrode {electrode} hold less than {100 * LOST:.0f} % of the voltage "
                "that the model of the skin and the other readings have: only noise"
            )
            yield Finding(Severity.ERROR, WHERE, what, f"check electrode {electrode}: its terminal, wire and switch")
