"""A pneumatic pad: a sealed cell of air under an elastic wall, and what its sensor makes of the pressure.

The wall sinks by x under the load L that the pad carries.  Air and wall share it, and the wall stiffens:

    L = A p + k x (1 + (x / x0)^2),     (P0 + p) (V0 - A x + C p) = P0 V0,

with C the bulging of the side walls.  Load near the pad's rim rests on the frame instead.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from .skin import Skin

AMBIENT, WARM = 101325.0, 295.0
AREA, VOLUME = 0.01, 70e-6
STIFFNESS, STIFFENING, BULGE = 25e3, 0.4e-3, 5e-10
RIM_SHARE, RIM_WIDTH = 0.45, 7e-3
"""Share of a load at the rim that the frame carries, and the distance over which it falls to a half, m."""
LEAK = 300.0
LATE = (0.3, 3.0, 30.0)
"""Times, s, with which the wall passes load on to the air."""
YIELD = 3.0
"""Load, N, over which a loop opens."""
LOWEST, HIGHEST, STEP = -2150.0, 34474.0, 10.5
"""Range of the sensor, Pa: zero lies at a tenth of its supply, and it follows down to a twentieth; and 12 bits."""


@dataclass(frozen=True, eq=False)
class Pads:
    """Gains of the sensors (pads,), their offsets (pads,) in Pa, and the mixing matrix (pads, pads)."""

    gain: np.ndarray
    offset: np.ndarray
    mixing: np.ndarray


def make_pads(count: int, crosstalk: float, rng: np.random.Generator) -> Pads:
    mixing = np.eye(count) + crosstalk * (1 - np.eye(count))
    return Pads(np.exp(0.05 * rng.standard_normal(count)), rng.uniform(100, 300, count), mixing)


def load_matrix(skin: Skin, places: np.ndarray) -> np.ndarray:
    """Share of a load at each place that reaches each pad, (pads, places)."""
    low, high = skin.pads[:, None, :2], skin.pads[:, None, 2:]
    depth = np.minimum(places - low, high - places).min(-1)
    return np.where(depth >= 0, 1 - RIM_SHARE / (1 + (depth / RIM_WIDTH) ** 2), 0.0)


def cell_pressure(load: np.ndarray) -> np.ndarray:
    """Pressure p, Pa gage, of a cell under ``load``, N, by Newton's method in the wall's travel x."""
    x = np.zeros_like(load)
    for _ in range(30):
        pressure, slope = _air(x)
        missing = AREA * pressure + STIFFNESS * x * (1 + (x / STIFFENING) ** 2) - load
        x = x - missing / (AREA * slope + STIFFNESS * (1 + 3 * (x / STIFFENING) ** 2))
    return _air(x)[0]


def _air(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root p of C p^2 + (V + P0 C) p - P0 A x = 0 with V = V0 - A x, and its slope in x."""
    b = VOLUME - AREA * x + AMBIENT * BULGE
    root = np.sqrt(b**2 + 4 * BULGE * AMBIENT * AREA * x)
    pressure = (root - b) / (2 * BULGE)
    return pressure, AREA * (AMBIENT + pressure) / root


def yielding(load: np.ndarray, opening: float) -> np.ndarray:
    """Load (samples, pads) after hysteresis: Bouc and Wen's z' = u' - |u'| z / YIELD, solved exactly step by step.

    The loop is at most ``opening`` of 20 N wide.
    """
    state, found = np.zeros(load.shape[1]), np.empty_like(load)
    fade = np.exp(-np.abs(np.diff(load, axis=0, prepend=load[:1])) / YIELD)
    goal = YIELD * np.sign(np.diff(load, axis=0, prepend=load[:1]))
    for k in range(len(load)):
        state = goal[k] + (state - goal[k]) * fade[k]
        found[k] = state
    return load - opening * 20.0 / (2 * YIELD) * found


def late(load: np.ndarray, rate: float, share: float) -> np.ndarray:
    """Load that reaches the air when ``share`` of it comes with the delays `LATE`."""
    slow = sum(_low_pass(load, rate, tau) for tau in LATE) / len(LATE)
    return (1 - share) * load + share * slow


def warmed(kelvin: np.ndarray, rate: float) -> np.ndarray:
    """Pressure, Pa, that a change of temperature (samples,) leaves in a cell that leaks slowly."""
    return AMBIENT / WARM * (kelvin - _low_pass(kelvin - kelvin[0], rate, LEAK) - kelvin[0])


def _low_pass(signal: np.ndarray, rate: float, tau: float) -> np.ndarray:
    keep = np.exp(-1 / (rate * tau))
    return lfilter([1 - keep], [1, -keep], signal, axis=0)


def sensed(pads: Pads, pressure: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """What the sensors report for cells at ``pressure`` (samples, pads), Pa."""
    mixed = pressure @ pads.mixing.T * pads.gain + pads.offset + noise
    return STEP * np.round(np.clip(mixed, LOWEST, HIGHEST) / STEP)
