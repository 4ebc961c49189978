"""Differences between the skins of a session and of a calibration, and presses that rest on pads."""

import numpy as np
from jaxtyping import Bool, Float

import jaxeit as je

from ..session import Session

# Radius of the area under a small tip and a usual layer, m; number of points on it; its least share on pads.
DEFAULT_RADIUS, AREA_POINTS, MIN_AREA_SHARE = 0.012, 64, 1 / 3


def differing_parts(session: Session, skin: je.Skin) -> tuple[str, ...]:
    """Of "sheet", "electrodes" and "pads" those that differ in shape, place or number; () without a skin to compare."""
    try:
        own = je.skin.parse_skin(session.skin_toml, "skin_toml")
    except ValueError:  # it describes none, or the check of the session says what is wrong with it
        return ()
    same = {
        "sheet": own.domain == skin.domain,
        "electrodes": own.electrodes == skin.electrodes,
        "pads": len(own.pads) == len(skin.pads)
        and all(np.array_equal(a.outline, b.outline) for a, b in zip(own.pads, skin.pads, strict=True)),
    }
    return tuple(part for part, is_same in same.items() if not is_same)


def rests_on_pads(
    skin: je.Skin, position: Float[np.ndarray, "presses 2"], tip_diameter: Float[np.ndarray, " presses"]
) -> Bool[np.ndarray, " presses"]:
    """Whether the middle of a tip or a third of its area lies on pads, which then measure its force.

    Presses of unknown place, and beyond the sheet, count as such: the check of places reports them.
    """
    radius = np.maximum(0.5 * tip_diameter, DEFAULT_RADIUS)[:, None, None]
    number = np.arange(AREA_POINTS)  # 0 is the middle; the others follow Vogel's spiral
    angle = np.pi * (3 - np.sqrt(5)) * number
    area = np.sqrt(number / AREA_POINTS)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    points = np.nan_to_num(position)[:, None] + radius * area
    flat = points.reshape(-1, 2)
    on_pads = skin.pads_at(flat).any(0).reshape(points.shape[:2])
    on_sheet = skin.domain.contains(flat).reshape(points.shape[:2])
    enough = (on_pads & on_sheet).sum(1) >= MIN_AREA_SHARE * on_sheet.sum(1)
    return np.asarray(on_pads[:, 0] | enough | ~on_sheet[:, 0] | ~np.isfinite(position).all(1))
