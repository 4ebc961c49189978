"""The picture of `jaxeit design`: the expected error of place over the sheet, scan by scan."""

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import jaxeit as je

from ..parts import MM, bare_figure

with suppress(ImportError):  # an extra: without it everything but the figures works
    from matplotlib.colors import LogNorm
if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ExpectedErrors(NamedTuple):
    """Expected error of place, with the skin and its scan.

    | meaning                            | shape      | unit |
    |------------------------------------|------------|------|
    | skin: sheet and electrodes         |            |      |
    | sites                              | (sites, 2) | m    |
    | error: expected at each site       | (sites,)   | m    |
    """

    skin: je.Skin
    sites: np.ndarray
    error: np.ndarray


def design_figure(maps: Mapping[str, ExpectedErrors]) -> "Figure":
    """A map for each title, all of one sheet and on one scale.

    Raises:
        ReportError: where matplotlib is not installed.
    """
    low, high = MM * np.asarray(next(iter(maps.values())).skin.domain.bounds)
    height = 4.2 * (high[1] - low[1]) / (high[0] - low[0])
    figure = bare_figure(4.2 * len(maps) + 1, height + 0.8, layout="constrained")
    every = MM * np.concatenate([found.error for found in maps.values()])
    norm = LogNorm(every.min(), max(every.max(), 1.01 * every.min()))
    axes = figure.subplots(1, len(maps), squeeze=False)[0]
    for panel, (name, (skin, sites, error)) in zip(axes, maps.items(), strict=True):
        side = 72 * 4.2 / max(2.0, np.sqrt(len(sites)))  # points: neighbours nearly touch
        drawn = panel.scatter(
            *MM * sites.T, c=MM * error, s=(0.75 * side) ** 2, marker="s", norm=norm, cmap="viridis_r"
        )
        panel.plot(*MM * skin.electrode_positions.T, "o", color="white", markeredgecolor="black", markersize=5)
        panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x, mm", ylabel="y, mm")
        panel.set_title(f"{name}, rms {MM * np.sqrt(np.mean(error**2)):.2g} mm", fontsize=10.5)
    figure.colorbar(drawn, ax=list(axes), label="expected error of place, mm", format="{x:g}")
    return figure
