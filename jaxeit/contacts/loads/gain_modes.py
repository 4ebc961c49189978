"""Modes of a field over the sheet that is not known, such as the gain of the contact layer."""

import numpy as np
from jaxtyping import Float


def field_modes(
    length: float, chart: Float[np.ndarray, "m 2"], *points: Float[np.ndarray, "_ 2"]
) -> tuple[Float[np.ndarray, "_ g"], ...]:
    """Modes of a Gaussian field of variance one: bumps whose sum of products is ``exp(-d^2 / 2 length^2)``.

    Args:
        length: over which the field changes, m.
        chart: places that span the sheet, m.
        points: where the modes are wanted, (n, 2) m; over the first of them the variance is one on the average.

    Returns:
        Where the modes lie, (g, 2) m, and their values (n, g) at each of the points.
    """
    axes = [
        np.arange(low - length, high + 1.5 * length, length)
        for low, high in zip(chart.min(0), chart.max(0), strict=True)
    ]
    nodes = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    values = [np.exp(-((at[:, None] - nodes) ** 2).sum(-1) / length**2) for at in points]
    norm = np.sqrt(np.mean((values[0] ** 2).sum(-1)))
    return nodes, *(value / norm for value in values)
