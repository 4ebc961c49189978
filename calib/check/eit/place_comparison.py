"""Compare the places of the presses with those at which the readings change."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

import jaxeit as je

from ...presses.means import press_means
from ...session import Stream
from ...session.units import SECOND
from ..evidence import PressEvidence
from ..parts import MIN_ROWS, RowRange, flagged_part
from ..report import ChannelTable, Finding, Severity, listed
from ..skin import beyond_electrodes, electrode_pitch
from .contact_places import locate_contacts
from .contradictions import MIN_CONTRADICTION
from .place_fits import place_fit, spread_text

WHERE = "/presses"
MIN_PLACES = 6  # for a comparison of places with the readings
MIN_SPREAD = 0.05  # standard deviation of the located places, of the size of the sheet
MIN_ALIKE = 0.5  # correlation of a change with that of a contact, from which the contact is located
CLEARLY_ALIKE = 0.85  # the same for a single press, which a loose electrode may spoil, and for their median
# Distances between electrodes by which located places are off: of the median press, of some, and of a single one.
MAX_AWAY, MAX_FEW, MAX_SINGLE = 0.35, 0.7, 1.25
BETTER, MOSTLY = 2.0, 0.85  # times nearer with a mistake undone, and share of the presses that are near
MAX_ROWS_OFF = 5  # rows of the table, by which its places are tried early and late
MAX_OTHERS = 0.2  # share of presses that are elsewhere, up to which they are single ones


def contact_findings(evidence: PressEvidence, skin: je.Skin, channels: ChannelTable, eit: Stream) -> Iterator[Finding]:
    """Places of the table that are mirrored, exchanged, moved or scaled, in all presses, some or single ones."""
    if evidence.site is None or channels.pattern.max() >= len(skin.electrodes):
        return
    bounds = np.asarray(skin.domain.bounds)
    rows, contacts, alike = _located(evidence, eit, channels, skin)
    # All contacts of a coat change the conductivity in one sense; a loose electrode gives either sign.
    usual = (alike < 0) == ((alike < 0).sum() >= len(alike) / 2)
    part = flagged_part(~usual)
    if part is not None:
        yield _sign_finding(part.text(evidence.times[evidence.seen[rows]], int(eit.time[0])))
        return
    sites = evidence.site[evidence.seen[rows]]
    told = usual & ~(skin.domain.contains(sites) & beyond_electrodes(skin, sites))
    rows, contacts, alike = rows[told], contacts[told], np.abs(alike[told])
    # The fields in closed form do not hold for all sheets, such as one with a corner that points inwards.
    clear = len(alike) > 0 and bool(np.median(alike) > CLEARLY_ALIKE)
    few = len(np.unique(contacts.round(4), axis=0)) < MIN_PLACES
    if few or (contacts.std(0) < MIN_SPREAD * np.ptp(bounds, axis=0)).any():
        return
    numbers, pitch = evidence.seen[rows], electrode_pitch(skin)
    site = evidence.site[numbers]
    away = np.linalg.norm(contacts - site, axis=1)
    if np.median(away) > MAX_AWAY * pitch or np.mean(away > MAX_FEW * pitch) > MAX_OTHERS:
        tried = {name: move(evidence.site)[numbers] for name, move in _moves(bounds.mean(0)).items()}
        found = _mistake(tried, site, contacts, pitch)
        if found is not None:
            name, part, left = found
            when = "" if part is None else f" {part.text(evidence.times[numbers], int(eit.time[0]))}"
            yield _mistake_finding(name, when, away if part is None else away[part.mask(len(away))], left)
        elif clear:
            yield from _fit_findings(site, contacts, pitch)
    elif clear and ((away > MAX_SINGLE * pitch) & (alike > CLEARLY_ALIKE)).any():
        other = (away > MAX_SINGLE * pitch) & (alike > CLEARLY_ALIKE)
        yield _single(evidence.number[numbers[other]], site[other], contacts[other], pitch)


def _sign_finding(when: str) -> Finding:
    what = f"the changes of the readings have the opposite sign {when}"
    return Finding(Severity.ERROR, "/streams/eit", what, "look for frames that were negated, or subtracted, there")


def _located(
    evidence: PressEvidence, eit: Stream, channels: ChannelTable, skin: je.Skin
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which of the presses whose frames were read have a contact that is found; its places and their correlations.

    The frames around the end of the ramp are read, because a tip may slide in the hold, or be followed by another one.
    """
    _, windows = evidence.compared()
    quarter = np.diff(windows.ramp, axis=1)[:, 0] // 4
    full = windows.ramp[:, 1]
    around = np.stack([full - quarter, full + quarter + SECOND // 20], 1)
    sound = ~channels.bad & ~(channels.reciprocity > MIN_CONTRADICTION)
    change = np.where(sound, press_means(eit, replace(windows, hold=around)).change.mean, np.nan)
    known = np.flatnonzero(np.isfinite(change).any(1))
    if not len(known) or not np.isfinite(change[known]).all(0).any():
        return np.empty(0, int), np.empty((0, 2)), np.empty(0)
    contacts, alike = locate_contacts(change[known], channels.pattern, skin, channels.mixing)
    good = np.abs(alike) > MIN_ALIKE
    return known[good], contacts[good], alike[good]


def _moves(middle: np.ndarray) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Possible mistakes in places (n, 2) by name, each with the function that undoes it."""
    flip = np.array([-1.0, 1.0])
    moves: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "x and y are exchanged": lambda p: p[:, ::-1],
        "x is mirrored": lambda p: middle + flip * (p - middle),
        "y is mirrored": lambda p: middle - flip * (p - middle),
        "the stage is turned by 180 degrees": lambda p: 2 * middle - p,
        "the stage is turned by 90 degrees": lambda p: middle + flip * (p - middle)[:, ::-1],
        "the stage is turned by -90 degrees": lambda p: middle - flip * (p - middle)[:, ::-1],
        "x and y are exchanged and both are mirrored": lambda p: (2 * middle - p)[:, ::-1],
        "the rows of the table are in reversed order": lambda p: p[::-1],
    }
    for by in range(1, MAX_ROWS_OFF + 1):
        count = "one press" if by == 1 else f"{by} presses"
        moves[f"the rows of the table come {count} early"] = lambda p, by=by: np.roll(p, by, axis=0)  # type: ignore[misc]
        moves[f"the rows of the table come {count} late"] = lambda p, by=by: np.roll(p, -by, axis=0)  # type: ignore[misc]
    return moves


def _mistake(
    tried: dict[str, np.ndarray], site: np.ndarray, contacts: np.ndarray, pitch: float
) -> tuple[str, RowRange | None, float] | None:
    """The mistake, and the part of the presses, that brings the places (rows, 2) nearest to the contacts, if any does.

    ``tried`` are the places with each mistake undone. Returns its name, the part (None: all presses) and the median
    distance that is left in it, m.
    """
    most = MAX_SINGLE * pitch  # a single press that is elsewhere counts for no more
    as_listed = np.minimum(np.linalg.norm(site - contacts, axis=1), most)
    best, least, left = None, float(as_listed.sum()) / BETTER, np.inf
    for whole in (True, False):
        for name, places in tried.items():
            undone = np.minimum(np.linalg.norm(places - contacts, axis=1), most)
            part = None if whole else _best_part(as_listed - undone)
            some = np.ones(len(site), bool) if part is None else part.mask(len(site))
            cost = float(undone[some].sum() + as_listed[~some].sum())
            near = np.quantile(np.where(some, undone, as_listed), MOSTLY) < MAX_FEW * pitch
            if cost < least and near and np.median(undone[some]) < MAX_AWAY * pitch:
                best, least, left = (name, part), cost, float(np.median(undone[some]))
        if best is not None:
            return *best, left
    return None


def _best_part(gain: np.ndarray) -> RowRange:
    """The first or the last part of the rows (rows,) with the largest sum of gains."""
    rows = len(gain)
    parts = [RowRange(row, first) for row in range(MIN_ROWS, rows - MIN_ROWS + 1) for first in (True, False)]
    return max(parts, key=lambda part: float(gain[part.mask(rows)].sum()))


def _mistake_finding(name: str, when: str, away: np.ndarray, left: float) -> Finding:
    off = f"the contacts that EIT sees lie {1e3 * np.median(away):.0f} mm from the places as listed (median)"
    what = f"the places look wrong{when}: {name}; {off}, {1e3 * left:.0f} mm so"
    return Finding(Severity.ERROR, WHERE, what, "correct x and y of the table, or the axes of the stage")


def _fit_findings(site: np.ndarray, contacts: np.ndarray, pitch: float) -> Iterator[Finding]:
    """Places (rows, 2) that are the same, shifted, scaled or turned against the contacts, or do not match them."""
    off = f"the contacts that EIT sees lie {1e3 * _distance(site, contacts):.0f} mm from the places as listed (median)"
    narrow = spread_text(site, contacts)
    fit = "" if narrow else place_fit(site, contacts, pitch)
    if narrow:
        what = f"the places do not match the readings that change: {narrow}"
        yield Finding(Severity.WARNING, WHERE, what, "give metres in the frame of the skin, a place for each press")
    elif fit:
        what = f"the places look {fit}: {off}"
        yield Finding(Severity.WARNING, WHERE, what, "correct the origin, the axes or the unit of x and y")
    elif np.mean(np.linalg.norm(site - contacts, axis=1) > MAX_FEW * pitch) > MAX_OTHERS:
        remedy = "compare the order of the table and the frame of the stage with the skin's file"
        yield Finding(Severity.WARNING, WHERE, f"the places do not match the readings that change: {off}", remedy)


def _distance(places: np.ndarray, contacts: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(places - contacts, axis=1)))


def _single(numbers: np.ndarray, site: np.ndarray, contacts: np.ndarray, pitch: float) -> Finding:
    """Single presses (their numbers) whose places (n, 2) are wrong, and where their contacts (n, 2) are."""
    what = f"the readings change elsewhere than listed in {len(numbers)} press{'es' if len(numbers) > 1 else ''}: "
    what += listed(
        f"press {number} near x = {x:.3f} m, y = {y:.3f} m" for number, (x, y) in zip(numbers, contacts, strict=True)
    )
    if len(numbers) == 2 and _distance(site[::-1], contacts) < MAX_AWAY * pitch:
        what += f"; the places of presses {numbers[0]} and {numbers[1]} look exchanged"
    return Finding(Severity.WARNING, WHERE, what, "correct x and y of these presses in the table, or press them again")
