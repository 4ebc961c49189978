"""Fit a shift, a scale and a turn between the places of a table and those of located contacts."""

from collections.abc import Callable

import numpy as np

Fit = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

ROUNDS = 4  # of a fit that leaves out presses far from it
OUTLIER = 2.5  # times the median distance
MAX_LEFT, MAX_MISFIT = 0.6, 0.25  # of the distance as listed, and between electrodes, that a fit may leave
MUCH_BETTER = 0.6  # share of the misfit that is left, for which each axis has a scale of its own
MIN_SCALE, MIN_TURN = 1.15, 7.0  # factor and degrees; located places reach 1.1 and 3 by chance
MIN_SHIFT, MIN_SCALED = 0.35, 0.5  # distances between electrodes: of a shift, and of places that are scaled
NARROW = 0.1  # of the spread of the contacts, below which places are the same


def spread_text(places: np.ndarray, contacts: np.ndarray) -> str:
    """Words for places (n, 2) that hardly differ in x or y, while the contacts (n, 2) do; empty if they do too."""
    spans, seen = np.ptp(places, axis=0), np.ptp(contacts, axis=0)
    same = [(axis, i) for i, axis in enumerate("xy") if spans[i] < NARROW * seen[i]]
    said = (
        f"all {axis} lie within {1e3 * spans[i]:.2g} mm, near {places[:, i].mean():.3g} m, but those of the contacts "
        f"that EIT sees within {1e3 * seen[i]:.0f} mm"
        for axis, i in same
    )
    return "; ".join(said)


def place_fit(places: np.ndarray, contacts: np.ndarray, pitch: float) -> str:
    """Words for what moves the contacts (n, 2) onto the places (n, 2); empty if no fit explains them.

    A similarity (scale, turn and shift) is preferred to a scale for each axis with a shift. ``pitch`` is the distance
    between electrodes, m.
    """
    as_listed = float(np.median(np.linalg.norm(places - contacts, axis=1)))
    (turned, left), (stretched, left_of_axes) = (_robust(fit, places, contacts) for fit in (_similarity, _axes))
    if min(left, left_of_axes) > min(MAX_LEFT * as_listed, MAX_MISFIT * pitch):
        return ""
    scaled = as_listed > MIN_SCALED * pitch
    text = _axes_words(stretched) if left_of_axes < MUCH_BETTER * left else _similarity_words(turned, scaled)
    shift = np.median(places - contacts, axis=0)
    if text or np.linalg.norm(shift) < MIN_SHIFT * pitch:
        return text
    return f"shifted by {1e3 * shift[0]:+.0f} mm in x and {1e3 * shift[1]:+.0f} mm in y"


def _robust(fit: Fit, places: np.ndarray, contacts: np.ndarray) -> tuple[np.ndarray, float]:
    """Matrix of a fit of the contacts onto most of the places, and the median distance that is left, m."""
    good = np.ones(len(places), bool)
    for _ in range(ROUNDS):
        matrix, shift = fit(contacts[good], places[good])
        left = np.linalg.norm(contacts @ matrix.T + shift - places, axis=1)
        good = left <= OUTLIER * np.median(left)
    return matrix, float(np.median(left))


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares scale, turn and shift of points a (n, 2) onto b (n, 2), as complex numbers."""
    (p, q), (middle_a, middle_b) = (
        ((c - c.mean(0)) @ np.array([1, 1j]) for c in (a, b)),
        (c.mean(0) for c in (a, b)),
    )
    power = float(np.vdot(p, p).real)
    factor = np.vdot(p, q) / power if power > 0 else 1.0
    matrix = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return matrix, middle_b - matrix @ middle_a


def _similarity_words(matrix: np.ndarray, may_scale: bool) -> str:
    scale, turn = float(np.hypot(*matrix[:, 0])), float(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0])))
    scaled = f"scaled by {scale:.2g}" if may_scale and abs(np.log(scale)) > np.log(MIN_SCALE) else ""
    turned = f"turned by {turn:.0f} degrees" if abs(turn) > MIN_TURN else ""
    return " and ".join(filter(None, (scaled, turned)))


def _axes(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares scale of each axis and shift of points a (n, 2) onto b (n, 2)."""
    away, of_b = a - a.mean(0), b - b.mean(0)
    scale = (away * of_b).sum(0) / np.maximum((away**2).sum(0), np.finfo(float).tiny)
    return np.diag(scale), b.mean(0) - scale * a.mean(0)


def _axes_words(matrix: np.ndarray) -> str:
    x, y = np.diag(matrix)
    off = [
        f"{value:.2g} in {axis}" for axis, value in (("x", x), ("y", y)) if abs(np.log(abs(value))) > np.log(MIN_SCALE)
    ]
    return f"scaled by {' and '.join(off)}" if off else ""
