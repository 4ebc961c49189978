"""In which parts the skin that a session describes differs from the skin that it is used with."""

import numpy as np

import jaxeit as je

from ..session import Session


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
