"""Check where the presses are: on the sheet, where the table claims, and where the readings change."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np

import jaxeit as je

from ..presses.corrections import WindowMeans
from ..presses.means import hold_positions
from ..presses.times import select
from ..session import PressTable, Stream
from .evidence import PressEvidence
from .report import Finding, Severity, listed

WHERE = "/presses"
REMEDY = "give metres in the frame of the skin, not mm and not the frame of the stage"
MIN_PLACES = 6  # for a comparison of places with the readings
MIN_SPREAD = 0.05  # standard deviation of the places, of the size of the sheet
# Places estimated from the readings correlate with the true ones by 0.97, and by 0.8 with a broken electrode.
SUFFICIENT_CORRELATION, DOUBTFUL_CORRELATION, NO_CORRELATION = 0.8, 0.5, 0.3
NOISE_MULTIPLE = 3.0  # standard errors of a change that are noise
MIN_TIP, MAX_TIP = 5e-4, 0.5  # m, as a part of the sheet: diameters of tips
MAX_STAGE_ERROR = 0.005  # m between the table and the stage


def place_findings(
    evidence: PressEvidence, skin: je.Skin, pattern: np.ndarray | None, streams: Mapping[str, Stream]
) -> Iterator[Finding]:
    """Findings for places off the sheet, and places that contradict the stage, the pads or the readings."""
    site, presses = evidence.site, evidence.presses
    if site is None:
        return
    outside = np.flatnonzero(~skin.domain.contains(site))
    if len(outside):
        x, y = site[outside[0]]
        first = f"press {evidence.number[outside[0]]} at x = {x:.4g} m, y = {y:.4g} m"
        what = f"{len(outside)} of {len(site)} presses lie outside the sheet ({first})"
        yield Finding(Severity.ERROR, WHERE, what, REMEDY)
        return
    if isinstance(presses, PressTable):
        yield from _table_findings(presses, evidence, skin, streams)
    if pattern is not None:
        yield from _reading_findings(evidence, skin, pattern)


def _table_findings(
    presses: PressTable, evidence: PressEvidence, skin: je.Skin, streams: Mapping[str, Stream]
) -> Iterator[Finding]:
    size = float(np.ptp(skin.domain.bounds, axis=0).max())
    tip = presses.tip_diameter[evidence.number]
    wrong = (tip > 0) & ((tip < MIN_TIP) | (tip > MAX_TIP * size))
    if wrong.any():
        what = f"a tip of {tip[wrong][0]:.4g} m diameter on a sheet of {size:.3g} m"
        yield Finding(Severity.WARNING, WHERE, what, "give tip_diameter in metres")
    claimed = presses.pad[evidence.number]
    beyond = claimed >= len(skin.pads)
    inside = pads_under(skin, evidence.site)
    elsewhere = ~beyond & (claimed >= 0) & ~inside[np.clip(claimed, 0, len(skin.pads) - 1), np.arange(len(claimed))]
    if skin.pads and (beyond | elsewhere).any():
        rows = evidence.number[beyond | elsewhere]
        what = f"{len(rows)} of {len(claimed)} presses name a pad that is not under their place: {listed(rows)}"
        yield Finding(Severity.WARNING, WHERE, what, "correct the column pad, or x and y, of the table")
    if "stage" in streams and streams["stage"].channels >= 2:
        yield from _stage_findings(presses, evidence, streams["stage"])


def _stage_findings(presses: PressTable, evidence: PressEvidence, stage: Stream) -> Iterator[Finding]:
    away = hold_positions(select(presses, evidence.number), stage)[:, :2] - evidence.site
    distance = np.linalg.norm(away, axis=1)
    if np.isfinite(distance).any() and np.nanmedian(distance) > MAX_STAGE_ERROR:
        x, y = 1e3 * np.nanmedian(away, axis=0)
        what = (
            f"the stage stands {1e3 * np.nanmedian(distance):.3g} mm from the places of the table (median; "
            f"{x:+.1f} mm in x, {y:+.1f} mm in y)"
        )
        remedy = "give the stage and the table in the frame of the skin, both in metres"
        yield Finding(Severity.WARNING, "/streams/stage", what, remedy)


# --- places and readings ------------------------------------------------------------------------------


def estimate_places(change: WindowMeans, pattern: np.ndarray, electrodes: np.ndarray) -> np.ndarray:
    """Rough places (presses, 2) m: the middles of the readings' electrodes, weighted by how much the readings change.

    The middle of the sheet draws the places, so that only their order means something. NaN where nothing changes.

    Args:
        change: of the readings over the hold (presses, readings) V; only what exceeds the noise counts.
        pattern: drive+, drive-, sense+, sense- (readings, 4).
        electrodes: their positions (electrodes, 2) m.
    """
    excess = np.abs(change.mean) - NOISE_MULTIPLE * np.nan_to_num(change.standard_error)
    weight = np.maximum(np.nan_to_num(excess), 0)
    total = weight.sum(1, keepdims=True)
    return np.asarray(weight @ electrodes[pattern].mean(1) / np.where(total > 0, total, np.nan))


def _moves(middle: np.ndarray) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Possible mistakes in places (n, 2) by name, each with the function that undoes it."""
    flip = np.array([-1.0, 1.0])
    return {
        "x and y are exchanged": lambda p: p[:, ::-1],
        "x is mirrored": lambda p: middle + flip * (p - middle),
        "y is mirrored": lambda p: middle - flip * (p - middle),
        "the stage is turned by 180 degrees": lambda p: 2 * middle - p,
        "the stage is turned by 90 degrees": lambda p: middle + flip * (p - middle)[:, ::-1],
        "the stage is turned by -90 degrees": lambda p: middle - flip * (p - middle)[:, ::-1],
        "the rows of the table come one press early": lambda p: np.roll(p, 1, axis=0),
        "the rows of the table come one press late": lambda p: np.roll(p, -1, axis=0),
        "the rows of the table are in reversed order": lambda p: p[::-1],
    }


def _agreement(places: np.ndarray, estimated: np.ndarray) -> float:
    """The lesser of the correlations in x and in y."""
    good = np.isfinite(estimated).all(1)
    pairs = zip(places[good].T, estimated[good].T, strict=True)
    return float(min(np.corrcoef(a, b)[0, 1] if np.ptp(a) > 0 and np.ptp(b) > 0 else 0.0 for a, b in pairs))


def _reading_findings(evidence: PressEvidence, skin: je.Skin, pattern: np.ndarray) -> Iterator[Finding]:
    """Compare the places of the presses with those at which the readings change."""
    if evidence.eit is None or evidence.site is None or pattern.max() >= len(skin.electrodes):
        return
    bounds = np.asarray(skin.domain.bounds)
    estimated, site = estimate_places(evidence.eit, pattern, skin.electrode_positions), evidence.site
    of_seen, found = site[evidence.seen], np.isfinite(estimated).all(1)
    few = len(np.unique(of_seen[found].round(4), axis=0)) < MIN_PLACES
    if few or (of_seen.std(0) < MIN_SPREAD * np.ptp(bounds, axis=0)).any():
        return
    as_listed = _agreement(of_seen, estimated)
    if as_listed > DOUBTFUL_CORRELATION:
        return
    moves = _moves(bounds.mean(0)).items()
    fits = {name: _agreement(move(site)[evidence.seen], estimated) for name, move in moves}
    best = max(fits, key=lambda name: fits[name])
    numbers = f"correlation with the places of the readings that change {as_listed:.2f} as listed"
    if fits[best] > SUFFICIENT_CORRELATION:
        what = f"the places look wrong: {best}; {numbers} and {fits[best]:.2f} so"
        yield Finding(Severity.ERROR, WHERE, what, "correct x and y of the table, or the axes of the stage")
    elif as_listed < NO_CORRELATION:
        what = f"the places do not match the readings that change: {numbers}"
        remedy = "compare the order of the table and the frame of the stage with the skin's file"
        yield Finding(Severity.WARNING, WHERE, what, remedy)


def pads_under(skin: je.Skin, site: np.ndarray | None) -> np.ndarray:
    """Whether a place lies on a pad, (pads, places)."""
    if site is None:
        return np.zeros((len(skin.pads), 0), bool)
    outlines = (je.Polygon(tuple((float(x), float(y)) for x, y in pad.outline)) for pad in skin.pads)
    return np.array([outline.contains(site) for outline in outlines]).reshape(len(skin.pads), len(site))
