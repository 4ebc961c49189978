"""The rectangle with point electrodes: Green's function by separation of variables.

``G = (1/a)[b/3 - y> + (y^2 + y'^2)/(2b)]
    + (2/a) sum_m cos kx cos kx' cosh(k y<) cosh(k (b - y>)) / (k sinh kb)``,  k = m pi / a,

for the sheet [0, a] x [0, b] with insulated rim, sheet conductance one and the current taken out
evenly over the area (which cancels between a source and a sink).
"""

import numpy as np


def green(a: float, b: float, at, source, terms: int = 4000) -> float:
    (x, y), (u, v) = at, source
    low, high = min(y, v), max(y, v)
    k = np.arange(1, terms + 1) * np.pi / a
    # cosh cosh / sinh in exponentials that never overflow
    ratio = np.exp(k * (low - high)) * (1 + np.exp(-2 * k * low)) * (1 + np.exp(-2 * k * (b - high)))
    ratio /= 2 * (1 - np.exp(-2 * k * b))
    series = np.sum(np.cos(k * x) * np.cos(k * u) * ratio / k)
    return (b / 3 - high + (y * y + v * v) / (2 * b)) / a + 2 / a * series


def four_point(a: float, b: float, source, sink, plus, minus) -> float:
    """Voltage between two points per ampere between two others, sheet resistance one."""
    return green(a, b, plus, source) - green(a, b, minus, source) - green(a, b, plus, sink) + green(a, b, minus, sink)
