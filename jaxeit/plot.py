"""Pictures with matplotlib, one call each: sheet and electrodes, mesh, image, sensitivity, current lines, contacts.

Every function draws on ``axes``, or on a new figure of `matplotlib.pyplot`, and returns the Axes; save the picture by
``axes.figure.savefig("picture.png")``. Lengths are drawn in mm. Install ``jaxeit[plot]``.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    skin = je.load_skin("testbed")
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    axes = je.plot.show_mesh(model)
    je.plot.show_skin(skin, axes)  # on top of the mesh
    axes.figure.savefig("mesh.png")
    je.plot.show_sensitivity(model, reading=0).figure.savefig("sensitivity.png")
    je.plot.show_current(model, (0, 12)).figure.savefig("current.png")  # in at electrode 0, out at 12
    sigma = model.background * jnp.where(
        jnp.linalg.norm(model.centroids - 0.06, axis=1) < 0.01, 1.5, 1.0
    )
    je.plot.show_image(model, sigma - model.background, label="S").figure.savefig("change.png")
"""

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .contacts import Contacts
from .model import Model, jacobian
from .model.bases import AbstractPictured, Picture
from .model.forward_model import fields
from .model.sheet_conductivity import coefficients
from .skin import Skin

try:  # an extra: without it the rest of jaxeit works
    from matplotlib import pyplot
    from matplotlib.patches import Ellipse
    from matplotlib.tri import LinearTriInterpolator, Triangulation
except ImportError:
    pyplot = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from matplotlib.axes import Axes
else:
    Axes = Any

__all__ = ["PlotError", "show_contacts", "show_current", "show_image", "show_mesh", "show_sensitivity", "show_skin"]

MM = 1e3
GREY, BLUE, ORANGE = "#8a8a8a", "#1f5fa8", "#d9730d"
ELLIPSE_90 = 2.1460  # radius over standard deviation of an ellipse that holds 90 %: sqrt(-2 log 0.1)
LINES_ACROSS = 121  # points of the grid, along the longer side, on which lines of current are followed
MOST_DECADES = 3.0  # of current densities, below the largest
NUMBER_OFFSET = 0.05  # of the sheet's size: from an electrode to its number


class PlotError(ValueError):
    """A picture that cannot be drawn."""


def show_skin(skin: Skin, axes: Axes | None = None, *, numbers: bool = True) -> Axes:
    """The sheet's outline, its pads and its electrodes with their numbers, counted from 0.

    Raises:
        PlotError: without matplotlib.
    """
    axes = _axes(axes)
    domain = skin.domain
    around = np.unique(np.append(domain.corners, np.linspace(0, domain.perimeter, 257)))
    axes.plot(*_mm(domain.boundary_point(around)), color="black", linewidth=1)
    for pad in skin.pads:
        axes.fill(*_mm(pad.outline), color=BLUE, alpha=0.15)
        x, y = _mm(np.min(pad.outline, 0))
        axes.text(x, y, f" {pad.name}", ha="left", va="bottom", color=BLUE, fontsize=8)
    middle, size = np.mean(domain.bounds, 0), np.ptp(domain.bounds, 0).max()
    for number, electrode in enumerate(skin.electrodes):
        place, edge = electrode.centre(domain), electrode.drawing(domain).edge
        if edge is not None:
            axes.plot(*_mm(edge), color=ORANGE, linewidth=4, solid_capstyle="butt")
        else:
            axes.plot(*_mm(place), "o", color=ORANGE, markersize=4)
        if numbers:  # outside at the rim, else above and to the right
            at_rim = domain.boundary_distance(place[None])[0] < 1e-3 * size
            out = (place - middle) / np.linalg.norm(place - middle) if at_rim else np.array([0.6, 0.6])
            x, y = _mm(place + NUMBER_OFFSET * size * out)
            axes.text(x, y, str(number), ha="center", va="center", fontsize=8)
    low, high = (
        MM * (np.array(end) + sign * 2 * NUMBER_OFFSET * size) for sign, end in zip((-1, 1), domain.bounds, strict=True)
    )
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return _labelled(axes)


def show_mesh(model: Model, axes: Axes | None = None) -> Axes:
    """The triangles of a model, in the sheet's flat coordinates.

    Raises:
        PlotError: without matplotlib.
    """
    axes = _axes(axes)
    axes.triplot(_triangles(model), color=GREY, linewidth=0.4)
    return _labelled(axes)


def show_image(
    where: AbstractPictured | Picture | Model,
    values: Float[Array, " n"] | Float[np.ndarray, " n"],
    axes: Axes | None = None,
    *,
    label: str = "",
) -> Axes:
    """An image with a colour bar; blue below zero, white at zero, red above, or shades of one colour for one sign.

    Args:
        where: the reconstructor, the basis or the picture of the image; the model, for a value per element.
        values: one per coefficient or element.
        label: of the colour bar.

    Raises:
        PlotError: if the values do not fit ``where``, or without matplotlib.
    """
    axes, drawn = _axes(axes), np.asarray(values, float)
    expected = len(where.areas)
    if drawn.shape != (expected,):
        raise PlotError(f"the image has shape {drawn.shape}; {type(where).__name__} has {expected} values")
    if not isinstance(where, Model) and len(where.shape) != 2:
        raise PlotError("the basis has no picture; give the model in place of it, for a value per element")
    finite = drawn[np.isfinite(drawn)]
    top = float(np.abs(finite).max()) if finite.size and np.abs(finite).max() > 0 else 1.0
    signed = finite.size == 0 or finite.min() < 0
    look: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -top} if signed else {"cmap": "viridis", "vmin": finite.min()}
    if isinstance(where, Model):
        shown = axes.tripcolor(_triangles(where), drawn, vmax=top, **look)
    else:
        picture = np.where(np.asarray(where.areas) > 0, drawn, np.nan).reshape(where.shape)
        x0, x1, y0, y1 = (MM * end for end in where.extent)
        shown = axes.imshow(picture, origin="lower", extent=(x0, x1, y0, y1), vmax=top, **look)
    axes.figure.colorbar(shown, ax=axes, label=label)
    return _labelled(axes)


def show_sensitivity(model: Model, reading: int | None = None, axes: Axes | None = None) -> Axes:
    """How much readings change with the conductivity of each place, in V/S per square metre.

    Args:
        reading: the number of one, drawn with its sign; default: the root of the sum of squares over all, on a
            logarithmic scale of powers of ten.

    Raises:
        PlotError: if there is no such reading, or without matplotlib.
    """
    if reading is not None and not 0 <= reading < model.readings:
        raise PlotError(f"reading {reading}: the protocol has readings 0 to {model.readings - 1}")
    slopes = jacobian(model) / model.areas
    if reading is not None:
        axes = show_image(model, slopes[reading], axes, label=f"reading {reading}, V/S/m$^2$")
        return axes
    size = np.asarray(jnp.sqrt(jnp.sum(slopes**2, 0)))
    decades = np.log10(np.where(size > 0, size, np.nan))  # zero, and left blank, under a perfect contact
    axes = _axes(axes)
    shown = axes.tripcolor(_triangles(model), decades, cmap="viridis")
    axes.figure.colorbar(shown, ax=axes, label="log10 of V/S/m$^2$")
    return _labelled(axes)


def show_current(
    model: Model,
    drive: tuple[int, int] | Float[np.ndarray, " electrodes"],
    axes: Axes | None = None,
    *,
    sigma: Float[Array, " elements"] | None = None,
) -> Axes:
    """Lines of the current in the sheet, coloured by its density on a logarithmic scale, in A through a metre.

    Args:
        drive: numbers of the electrodes at which 1 A enters and leaves, or the current into each, (electrodes,) A,
            such as a column of the matrix of `Protocol.from_matrices`.
        sigma: conductivity, (elements,) S; default: that of the model.

    Raises:
        PlotError: for electrodes that the model does not have, currents that do not sum to zero, or without matplotlib.
    """
    flow = _current_density(model, _driven(model, drive), sigma)
    triangles, weight = np.asarray(model.triangles), np.asarray(model.areas)
    shares = np.bincount(triangles.ravel(), np.repeat(weight, 3), minlength=len(model.chart))
    nodal = [np.bincount(triangles.ravel(), np.repeat(weight * part, 3), minlength=len(shares)) for part in flow.T]
    axes, mesh = _axes(axes), _triangles(model)
    low, high = (np.array([end(mesh.x), end(mesh.y)]) for end in (np.min, np.max))
    step = (high - low).max() / (LINES_ACROSS - 1)
    x, y = (np.arange(a, b + 0.5 * step, step) for a, b in zip(low, high, strict=True))
    along, up = (LinearTriInterpolator(mesh, part / shares)(*np.meshgrid(x, y)) for part in nodal)
    decades = np.ma.log10(np.ma.hypot(along, up))  # blank beside the sheet, and where no current flows
    decades = np.ma.clip(decades, decades.max() - MOST_DECADES, None)
    shown = axes.streamplot(x, y, along, up, color=decades, cmap="viridis_r", linewidth=0.8, density=1.5)
    axes.figure.colorbar(shown.lines, ax=axes, label="log10 of A/m")
    return _labelled(axes)


def _driven(model: Model, drive: tuple[int, int] | Float[np.ndarray, " electrodes"]) -> np.ndarray:
    """The current into each electrode; raises PlotError for what no scan can drive."""
    count = model.electrodes
    if isinstance(drive, tuple):
        source, sink = drive
        if source == sink or not (0 <= source < count and 0 <= sink < count):
            raise PlotError(f"drive {drive}: give the numbers of two electrodes, from 0 to {count - 1}")
        pair: np.ndarray = np.eye(count)[source] - np.eye(count)[sink]
        return pair
    current = np.asarray(drive, float)
    largest = np.abs(current).max(initial=0)
    if current.shape != (count,) or not largest > 0 or abs(current.sum()) > 1e-6 * largest:
        raise PlotError(f"the drive has shape {current.shape}; give {count} currents, A, that sum to zero")
    return current


def _current_density(model: Model, current: np.ndarray, sigma: Float[Array, " elements"] | None) -> np.ndarray:
    """The current through a unit of length, (elements, 2) A/m, in the sheet's flat coordinates.

    Slopes are those of the potential at the corners of a triangle, also for quadratic elements.
    """
    theta = coefficients(model, sigma)
    potential = np.asarray(fields(model, theta).potential) @ current
    corners = potential[np.asarray(model.system.dofs)[:, :3]]
    triangles = np.asarray(model.triangles)
    sides, flat = (np.diff(np.asarray(points)[triangles], axis=1) for points in (model.nodes, model.chart))
    rise = np.linalg.solve(sides @ sides.swapaxes(1, 2), np.diff(corners, axis=1)[..., None])
    density: np.ndarray = -np.asarray(theta.sigma)[:, None] * (flat.swapaxes(1, 2) @ rise)[..., 0]
    return density


def show_contacts(contacts: Contacts, axes: Axes | None = None) -> Axes:
    """The contacts of one frame: number, centre, width as a dashed circle, and the ellipse that holds it with 90 %.

    Raises:
        PlotError: for several frames, or without matplotlib.
    """
    if contacts.present.ndim != 1:
        raise PlotError(f"contacts of {contacts.present.shape[:-1]} frames; give those of one")
    axes = _axes(axes)
    for number in np.flatnonzero(np.asarray(contacts.present)):
        place = _mm(np.asarray(contacts.position[number]))
        axes.plot(*place, "x", color="black")
        axes.annotate(str(number), place, (4, 4), textcoords="offset points", fontsize=8)
        spread = 2 * MM * float(contacts.width[number])
        axes.add_patch(Ellipse(place, spread, spread, fill=False, color=GREY, linestyle="--"))
        variance, along = np.linalg.eigh(np.asarray(contacts.covariance[number, :2, :2], float))
        width, height = 2 * MM * ELLIPSE_90 * np.sqrt(np.maximum(variance, 0))
        angle = float(np.degrees(np.arctan2(along[1, 0], along[0, 0])))
        axes.add_patch(Ellipse(place, width, height, angle=angle, fill=False, color=ORANGE))
    return _labelled(axes)


def _axes(axes: Axes | None) -> Axes:
    if pyplot is None:
        raise PlotError("pictures need matplotlib, which is not installed; install jaxeit[plot]")
    return pyplot.subplots(layout="constrained")[1] if axes is None else axes


def _mm(points: np.ndarray) -> Any:
    """Coordinates in mm, as two arrays or two numbers."""
    return MM * np.asarray(points).T


def _triangles(model: Model) -> Any:
    x, y = _mm(np.asarray(model.chart))
    return Triangulation(x, y, np.asarray(model.triangles))


def _labelled(axes: Axes) -> Axes:
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    return axes
