"""Presses whose stated force or place the other presses contradict, as after a slip of the stage or of a log."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from .pooled import PooledPresses
from .streams import robust_deviation

# How far a press must lie from what the others tell: so many times the usual error, and for a force this part of it,
# for a place this part of the shorter side of the box of places.
FAR, PART_OF_FORCE, PART_OF_BOX = 10.0, 0.25, 0.15
MAX_SHARE = 0.05  # of presses; if more are far, and more than one, the fit does not hold, and no press is to blame
NAMED = 3  # presses that a line names


def contradicted_presses(
    presses: PooledPresses, force: Float[np.ndarray, " n"], place: Float[np.ndarray, "n 2"] | None = None
) -> tuple[str, ...]:
    """Lines for the operator that name such presses; empty for none.

    Args:
        force: that a fit to the presses at other places tells of each press, (presses,) N; NaN: not known.
        place: that the image tells, (presses, 2) m; None: not known.
    """
    stated = presses.data.force
    far = _far(np.abs(force - stated), PART_OF_FORCE * np.maximum(force, stated))
    forces = [f"{stated[k]:.1f} N stated, {force[k]:.1f} N by its pressure" for k in far]
    lines = list(_lines(presses, far, "force", forces))
    if place is not None:
        away = np.hypot(*(place - presses.position).T)
        far = _far(away, PART_OF_BOX * np.ptp(presses.data.reach, axis=0).min())
        lines += _lines(
            presses, far, "place", [f"{_mm(presses.position[k])} stated, {_mm(place[k])} by its image" for k in far]
        )
    return tuple(lines)


def _far(error: Float[np.ndarray, " n"], least: Float[np.ndarray, "..."] | float) -> np.ndarray:
    """Rows of the presses whose error is far larger than usual."""
    known = np.isfinite(error)
    far = np.flatnonzero(known & (error > np.maximum(FAR * robust_deviation(error[known]), least)))
    return far if len(far) <= max(1, MAX_SHARE * len(error)) else far[:0]


def _lines(presses: PooledPresses, far: np.ndarray, what: str, said: list[str]) -> Iterator[str]:
    session = presses.groups["session"]
    rows = np.concatenate([np.flatnonzero(m.presses.accepted) for m in presses.recordings])
    for number, recording in enumerate(presses.recordings):
        own = [(rows[k], text) for k, text in zip(far, said, strict=True) if session[k] == number]
        if own:
            named = "; ".join(f"press {row}: {text}" for row, text in own[:NAMED])
            more = f"; and {len(own) - NAMED} more" if len(own) > NAMED else ""
            yield (
                f"{recording.session.name}: the other presses contradict the {what} of {named}{more}; check the log of "
                "the stage, and set such a press aside (accepted = 0 in /presses)"
            )


def _mm(place: Float[np.ndarray, "2"]) -> str:
    return f"({1e3 * place[0]:.0f}, {1e3 * place[1]:.0f}) mm"
