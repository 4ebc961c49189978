"""The picture of `jaxeit design`: the expected error of place over the sheet, scan by scan."""

from collections.abc import Mapping

import numpy as np

import jaxeit as je

from .figures import MM, require_matplotlib

try:  # an extra, as for all figures
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
except ImportError:
    Figure = None  # type: ignore[assignment,misc]


def design_figure(skin: je.Skin, sites: np.ndarray, errors: Mapping[str, np.ndarray]) -> "Figure":
    """A map for each scan, on one scale.

    Args:
        skin: sheet and electrodes.
        sites: (sites, 2) m.
        errors: by title, the expected error at each site, (sites,) m.

    Raises:
        ReportError: where matplotlib is not installed.
    """
    require_matplotlib()
    low, high = MM * np.asarray(skin.domain.bounds)
    height = 4.2 * (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(4.2 * len(errors) + 1, height + 0.8), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    every = MM * np.concatenate(list(errors.values()))
    norm = LogNorm(every.min(), max(every.max(), 1.01 * every.min()))
    axes = figure.subplots(1, len(errors), squeeze=False)[0]
    side = 72 * 4.2 / max(2.0, np.sqrt(len(sites)))  # points: neighbours nearly touch
    for panel, (name, error) in zip(axes, errors.items(), strict=True):
        found = panel.scatter(
            *MM * sites.T, c=MM * error, s=(0.75 * side) ** 2, marker="s", norm=norm, cmap="viridis_r"
        )
        panel.plot(*MM * skin.electrode_positions.T, "o", color="white", markeredgecolor="black", markersize=5)
        panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x, mm", ylabel="y, mm")
        panel.set_title(f"{name}, rms {MM * np.sqrt(np.mean(error**2)):.2g} mm", fontsize=10.5)
    figure.colorbar(found, ax=list(axes), label="expected error of place, mm", format="{x:g}")
    return figure
