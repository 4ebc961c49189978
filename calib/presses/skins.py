"""How the skin of a session differs from the one that it is used with, and which presses rest on its pads."""

import numpy as np
from jaxtyping import Bool, Float

import jaxeit as je

from ..session import Session

# Radius of the area on which a small tip presses through a usual layer, m; points on it; the least part on pads.
USUAL_RADIUS, AREA_POINTS, MIN_PART = 0.012, 64, 1 / 3


def differing_parts(session: Session, skin: je.Skin) -> tuple[str, ...]:
    """Of "sheet", "electrodes" and "pads" those that differ in shape, place or number; () without a skin to compare."""
    try:
        own = je.skin.parse_skin(session.skin_toml, "skin_toml")
    except ValueError:  # it describes none, or the check of the session says what is wrong with it
        return ()
    alike = {
        "sheet": own.domain == skin.domain,
        "electrodes": own.electrodes == skin.electrodes,
        "pads": len(own.pads) == len(skin.pads)
        and all(np.array_equal(a.outline, b.outline) for a, b in zip(own.pads, skin.pads, strict=True)),
    }
    return tuple(part for part, same in alike.items() if not same)


def rests_on_pads(
    skin: je.Skin, position: Float[np.ndarray, "presses 2"], tip_diameter: Float[np.ndarray, " presses"]
) -> Bool[np.ndarray, " presses"]:
    """Whether the middle of a tip or a third of what it presses lies on pads, which then tell its force.

    Presses of unknown place, and beyond the sheet, count as such: the check of places names what is wrong with them.
    """
    radius = np.maximum(0.5 * tip_diameter, USUAL_RADIUS)[:, None, None]
    number = np.arange(AREA_POINTS)  # 0 is the middle; the others follow Vogel's spiral
    turn = np.pi * (3 - np.sqrt(5)) * number
    area = np.sqrt(number / AREA_POINTS)[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    points = np.nan_to_num(position)[:, None] + radius * area
    flat = points.reshape(-1, 2)
    on_pads = skin.pads_at(flat).any(0).reshape(points.shape[:2])
    on_sheet = skin.domain.contains(flat).reshape(points.shape[:2])
    part = (on_pads & on_sheet).sum(1) >= MIN_PART * on_sheet.sum(1)
    return np.asarray(on_pads[:, 0] | part | ~on_sheet[:, 0] | ~np.isfinite(position).all(1))
