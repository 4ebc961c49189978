"""Preparing a finder of contacts: everything that does not depend on the frame."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import full_precision, require_known, verb
from ..imaging.inputs import InverseError, real_numbers
from ..imaging.readings.whitening import Whitened, whitened_readings
from ..imaging.untouched import background_of
from ..messages.kinds import require_kind
from ..model.bases import Elements
from ..model.discretisation import Model, require_model
from ..model.sensitivity import pair_jacobian
from .bump_responses import Nodes, mean_conductivity, signal_subspace, spline_responses, table_nodes, tabulate
from .fit import contact_bounds
from .search import ContactFinder
from .settings import ContactSettings

# Frames of noise that set the threshold.
NOISE_FRAMES = 512
# Least root mean square of whitened readings of bumps, along a direction in which contacts are sought.
MIN_SIGNAL = 0.1
# Widths of the atoms, as fractions of the way from the narrowest to the widest level of the table.
ATOM_WIDTHS = (0.35, 0.6, 0.85)


@full_precision
def prepare_contacts(
    model: Model,
    settings: ContactSettings | None = None,
    *,
    noise: Float[ArrayLike, "..."],
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> ContactFinder:
    """Do everything that does not depend on the frame once: make a finder of contacts.

    The finder adds contacts one by one and fits each number of contacts by Levenberg-Marquardt from two starts: the
    bump that explains most of the rest, and the strongest contact split in two. Where the fit of one contact ends
    badly, as it may beside an electrode, it starts once more from the bump that explains most of those unlike the
    first; where both fits of two contacts do, a third from the two bumps that explain most together. With the names of
    `ContactSettings`, it goes on for as long as

    - chi-square falls by more than noise alone makes it fall in a fraction ``false_alarm`` of blank frames. The largest
      fall over all places and widths follows ``P(fall > z^2) = 1 - exp(-N (z^2 - 1) exp(-z^2 / 2))``, the Euler
      characteristic of a Gaussian field in three dimensions (Adler 1981), with N from simulated noise;
    - and, from the second contact on, chi-square falls by more than ``(model_error |y|)^2`` and than ``ratio^2`` times
      the rest (for the third contact ``(2 ratio)^2``, and so on): no real contact is exactly a Gaussian on a sheet
      that is exactly known, and the difference must not become a contact;
    - and two contacts explain as much more than one oblong contact, a row of four bumps (an edge is not two contacts);
    - and all contacts are further apart than ``separation`` times their mean width, and none is below a tenth of the
      strongest.

    Args:
        settings: default `ContactSettings()`.
        noise: standard deviation of each reading, (readings,) V, or their covariance, (readings, readings) V^2.
        untouched: mean frame of the untouched sheet, (readings,) V, to which `fit_background` fits the sheet. Give it
            wherever there is one: on an uneven coating the error of place is otherwise more than twice as large.
        sigma: conductivity of the untouched sheet, (elements,) S, if it is known already; without either, the sheet is
            even.
        channels: readings to use; a dead reading is left out, never taken for zero.

    Raises:
        InverseError: if the noise is out of range, no channel is left, both ``untouched`` and ``sigma`` are given, or
            no coating explains the untouched frame.
        SceneError: if ``model`` is no model, such as a skin.
    """
    settings = ContactSettings() if settings is None else settings
    require_kind(
        settings, ContactSettings, InverseError, "settings of contacts", "ContactSettings(...)", "prepare_contacts"
    )
    sigma, whitened = sheet_and_readings("prepare_contacts", model, noise, untouched, sigma, channels)
    nodes = table_nodes(model, settings.widths, settings.columns)
    slopes, background = _relative_jacobian(model, whitened, sigma)
    table = tabulate(model, slopes, nodes.subsample(3))
    signal, complement = signal_subspace(table, MIN_SIGNAL)
    require_signal(signal.shape[1] > 0)
    values = tabulate(model, signal.T @ slopes, nodes)
    put = partial(jnp.asarray, dtype=model.dtype)
    bounds = contact_bounds(nodes.axes[1], nodes.axes[0], settings.widths)
    finder = ContactFinder(
        whitening=whitened.whitening,
        compress=put(signal.T @ whitened.compress),
        rest=put(complement.T @ whitened.compress),
        responses=spline_responses(values, nodes, background, model.dtype),
        **{name: put(array) for name, array in (_atoms(model, values, nodes) | bounds).items()},
        threshold=put(0),
        model_error=put(settings.model_error),
        ratio=put(settings.ratio),
        separation=put(settings.separation),
        root=put(np.eye(signal.shape[1])),
        whole=jnp.asarray(True),
        most=settings.most,
    )
    threshold = put(_threshold(finder, settings.false_alarm))
    with_threshold: ContactFinder = eqx.tree_at(lambda f: f.threshold, finder, threshold)
    return with_threshold


def sheet_and_readings(
    name: str,
    model: Model,
    noise: Float[ArrayLike, "..."],
    untouched: Float[ArrayLike, " readings"] | None,
    sigma: Float[Array, " elements"] | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> tuple[Float[Array, " elements"] | None, Whitened]:
    """Conductivity of the untouched sheet, S, None: even; and the whitening of readings, both on the host.

    Args:
        name: of the function that was called with the others, as `prepare_contacts` describes them.
    """
    require_model(model)
    require_known(name, InverseError, model, noise, untouched, sigma, channels)
    if noise is None:
        raise InverseError(f"{name}: noise is None; give the standard deviation of each reading, V")
    _require_conductivity(sigma)
    return background_of(model, untouched, sigma, channels), whitened_readings(model, noise, channels)


def _require_conductivity(sigma: object) -> None:
    """Refuse a conductivity that no sheet has."""
    if not hasattr(sigma, "shape"):
        return  # none, or what `background_of` refuses
    values = real_numbers("sigma", sigma, "S").ravel()
    bad = ~(np.isfinite(values) & (values > 0))
    if bad.any():
        raise InverseError(
            f"sigma of element {int(np.argmax(bad))} is {values[bad][0]:g} S; give the conductivity of each "
            "element, a finite number above zero, or the frame of the untouched skin (untouched=)"
        )


def require_signal(found: bool) -> None:
    """Refuse noise in which nothing can be found: no contact changes the whitened readings by `MIN_SIGNAL`."""
    if not found:
        raise InverseError(
            f"the noise hides every contact: none changes the readings by {MIN_SIGNAL:g} of it; give the "
            "standard deviation of each reading in V, such as 1e-6, as measured without contact"
        )


def _relative_jacobian(
    model: Model, whitened: Whitened, sigma: Float[Array, " elements"] | None
) -> tuple[np.ndarray, float]:
    """Whitened readings per relative change of the elements' conductivity, and its mean, S."""
    slopes = pair_jacobian(model, sigma, Elements().on(model), jnp.asarray(whitened.electrodes))
    conductivity = np.asarray(model.background if sigma is None else sigma, float)
    return whitened.factor @ (np.asarray(slopes, float) * conductivity), mean_conductivity(model, conductivity)


def _atoms(model: Model, values: np.ndarray, nodes: Nodes) -> dict[str, np.ndarray]:
    """Arrays of `Atoms`, by the fields of `ContactFinder`: narrow, medium and wide bumps all over the sheet."""
    y, x, log_width = nodes.axes
    indices = []
    for part in ATOM_WIDTHS:
        level = round(part * (len(log_width) - 1))
        stride = max(1, round(1.3 * np.exp(log_width[level]) / (x[1] - x[0])))
        i, j = np.meshgrid(np.arange(stride // 2, len(y), stride), np.arange(stride // 2, len(x), stride))
        indices.append(np.stack([i.ravel(), j.ravel(), np.full(i.size, level)], 1))
    i, j, level = np.concatenate(indices).T
    responses, starts = values[i, j, level], np.stack([x[j], y[i], log_width[level]], 1)
    norms = np.linalg.norm(responses, axis=1)
    kept = (norms > 1e-3 * norms.max()) & _on_sheet(model, starts[:, :2])
    atoms = responses[kept] / norms[kept, None]
    return {"atoms": atoms, "norms": norms[kept], "starts": starts[kept], "alike": atoms @ atoms.T}


def _on_sheet(model: Model, places: np.ndarray) -> np.ndarray:
    """Whether each place lies in a triangle."""
    corners = np.asarray(model.chart, float)[np.asarray(model.triangles)]
    inside = np.zeros(len(places), bool)
    slack = 1e-9 * np.ptp(corners)
    a, b = corners[:, [1, 2, 0]] - corners, corners
    for k, place in enumerate(places):
        side = a[..., 0] * (place[1] - b[..., 1]) - a[..., 1] * (place[0] - b[..., 0])
        inside[k] = (side >= -slack * np.ptp(corners)).all(1).any()
    return inside


def _threshold(finder: ContactFinder, false_alarm: float) -> float:
    """The fall of chi-square that noise alone exceeds in a part ``false_alarm`` of frames; see `prepare_contacts`."""
    noise = jnp.asarray(np.random.default_rng(0).standard_normal((NOISE_FRAMES, finder.compress.shape[0])))
    falls = np.sort(np.asarray(_noise_falls(finder, noise.astype(finder.compress.dtype)), float))
    tenth = max(falls[int(0.9 * NOISE_FRAMES)], 3.0)
    number = -np.log(0.9) / _euler_characteristic(tenth)
    return _bisect(lambda z: number * _euler_characteristic(z) + np.log1p(-false_alarm), 2.5, 400)


def _bisect(function: Callable[[float], float], low: float, high: float) -> float:
    """Root of a function above zero at ``low`` and below at ``high`` (scipy.optimize takes 0.1 s to import)."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) > 0 else (low, middle)
    return low


def _euler_characteristic(square: float) -> float:
    """Expected Euler characteristic of an excursion set of a Gaussian field in three dimensions, up to a factor.

    Args:
        square: of the level that the field exceeds.
    """
    return (square - 1) * float(np.exp(-0.5 * square))


@verb
def _noise_falls(finder: ContactFinder, y: Float[Array, "n r"]) -> Float[Array, " n"]:
    """Falls of chi-square by a fit of one contact to frames of noise."""
    bumps, atoms = finder.bumps(finder.root, finder.whole), finder.atom_table(finder.root, finder.whole)
    none = jnp.zeros((0, 4), y.dtype)

    def fall(frame: Float[Array, " r"]) -> Float[Array, ""]:
        return frame @ frame - bumps.fit(frame, atoms.add_best(bumps, frame, none)).square

    falls: Array = jax.lax.map(fall, y)
    return falls
