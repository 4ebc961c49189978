"""Check where the presses are: on the sheet, on the pads and at the stage as the table claims."""

from collections.abc import Iterator, Mapping

import numpy as np

import jaxeit as je

from ...presses.means import hold_positions
from ...presses.timing.times import select
from ...session import PressTable, Stream
from ..eit.place_comparison import contact_findings
from ..evidence import PressEvidence
from ..report import ChannelTable, Finding, Severity, listed

WHERE = "/presses"
REMEDY = "give metres in the frame of the skin, not mm and not the frame of the stage"
MIN_TIP, MAX_TIP = 5e-4, 0.5  # m, as a part of the sheet: diameters of tips
MAX_STAGE_ERROR = 0.005  # m between the table and the stage


def place_findings(
    evidence: PressEvidence, skin: je.Skin, channels: ChannelTable | None, streams: Mapping[str, Stream]
) -> Iterator[Finding]:
    """Findings for places off the sheet, and places that contradict the stage, the pads or the readings.

    Args:
        channels: the readings, if they tell places.
    """
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
    if channels is not None and "eit" in streams:
        yield from contact_findings(evidence, skin, channels, streams["eit"])


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


def pads_under(skin: je.Skin, site: np.ndarray | None) -> np.ndarray:
    """Whether a place lies on a pad, (pads, places); no columns for places that are not known."""
    if site is None:
        return np.zeros((len(skin.pads), 0), bool)
    return skin.pads_at(site)
