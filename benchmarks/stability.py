"""Numerical limits: error against severity on nine hard axes, in both precisions and in a textbook form."""

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxeit as je
from tests import hard_sheet as sheet, hard_strip as strip
from tests.oracles.rational import inverse_corner

from .figures import BLUE, GREY, ORANGE, legend, panels
from .harness import Question, Run
from .problems import square
from .rows import Row, grouped

FORMS = ("float64", "float32", "naive")
SOLVER = je.linalg.NestedDissection()
X, Y = sheet.MESH.centroids.T
FLAT = np.random.default_rng(0).integers(1, 33, len(X)) / 16.0
ONE = (1.0,) * 4
SIDE, DRAWS = 12, 100  # pixels along the image, and noises that a touch is drawn with

Errors = tuple[float, float, float]  # of float64, float32 and the naive form


class Axis(NamedTuple):
    """One way for things to get hard: its title, what its severity is, what the naive form is, what the error is, the
    errors at a severity, and the severities, the mildest first."""

    title: str
    severity: str
    naive: str
    error: str
    errors: Callable[[float], Errors]
    severities: Sequence[float]

    def row(self, severity: float) -> Row:
        """The errors that are finite, None for the others."""
        with np.errstate(all="ignore"):
            found = self.errors(severity)
        kept = {form: float(e) if np.isfinite(e) else None for form, e in zip(FORMS, found, strict=True)}
        return {"axis": self.title, "severity": severity} | kept


# The sheet of exact readings.


def read(sigma: np.ndarray, contacts: tuple[float, ...] = ONE, *, ground: tuple[float, float] | None = None) -> Errors:
    """Of the worst reading, relative to itself; naive: pseudo-inverse of Y, or a ground held in one place."""
    right = sheet.exact(sigma, contacts)
    models = (sheet.sheet_model(SOLVER, dtype) for dtype in ("float64", "float32"))
    double, single = (sheet.worst(sheet.found(model, sigma, contacts), right) for model in models)
    if ground is None:
        naive = sheet.by_schur_and_pinv(sigma, contacts)
    else:
        node = int(np.argmin(np.linalg.norm(sheet.MESH.nodes - np.asarray(ground), axis=1)))
        naive = sheet.found(sheet.grounded(sheet.sheet_model(SOLVER), node), sigma, contacts)
    return double, single, sheet.worst(naive, right)


def _power(value: float) -> float:
    """The nearest power of two, which both precisions hold."""
    return float(2.0 ** np.round(np.log2(value)))


def _drawn(ratio: float) -> np.ndarray:
    """Conductivities between 1 / root(ratio) and root(ratio), each element its own."""
    decades = np.random.default_rng(1).uniform(-0.5, 0.5, len(X)) * np.log2(ratio)
    return 2.0 ** np.round(decades)


def _wave(ratio: float) -> np.ndarray:
    return 2.0 ** np.round(0.5 * np.log2(ratio) * np.sin(2 * np.pi * X / 8) * np.cos(np.pi * Y / 4))


def _torn(left: float, depth: float) -> np.ndarray:
    """A gap in the middle, as deep as that, where so much of the conductivity is left."""
    return np.where((X > 3) & (X < 5) & (depth > Y), _power(left), 1.0) * FLAT


# The strip that reads the same on any mesh; slivers pass here although the check of meshes refuses below 20 degrees.


def _on_the_strip(mesh: je.meshing.Mesh) -> Errors:
    double, single = (strip.strip_error(mesh, dtype) for dtype in ("float64", "float32"))
    return double, single, strip.strip_error(strip.in_single_precision(mesh))


# Images and force maps.


@cache
def _image_skin() -> je.Skin:
    """A square with one pad, and electrodes at nine places, read between pairs that share none."""
    places = [(0.05 * i, 0.05 * j) for j in (1, 2, 3) for i in (1, 2, 3)]
    pairs = np.array([[a, a + 1, b, b + 1] for a in range(8) for b in range(a + 2, 8)])
    pad = je.Pad("whole", np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]]))
    return square(np.array(places), pairs, (pad,))


@cache
def _image_model(dtype: str) -> je.Model:
    skin = _image_skin()
    mesh = je.meshing.structured(skin.domain, SIDE, SIDE)  # type: ignore[arg-type]  # the rectangle above
    return je.discretise(je.Scene(skin), je.Fidelity(dtype=dtype, solver=je.linalg.Dense()), mesh=mesh)


@cache
def _basis(dtype: str) -> je.model.BasisMap:
    return je.Pixels(SIDE).on(_image_model(dtype))


@cache
def _touched() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian, Tikhonov's weights, the change of the readings by a touch, and J R^-1 J^T in fractions."""
    model, basis = _image_model("float64"), _basis("float64")
    touch = jnp.exp(-jnp.sum((model.centroids - jnp.array([0.07, 0.12])) ** 2, 1) / (2 * 0.02**2))
    j = np.asarray(je.jacobian(model, basis=basis))
    r = np.asarray(je.Tikhonov().precision(jnp.asarray(j), basis.picture).values)
    dv = np.asarray(je.forward(model, model.background * (1 + touch)) - je.forward(model))
    exact = np.vectorize(Fraction, otypes=[object])
    return j, r, dv, (exact(j) / exact(r)) @ exact(j).T


def regularisation(weight: float) -> Errors:
    """Of the image of a touch, relative to its largest pixel; naive: inv(J^T J + l^2 R) J^T dv."""
    j, r, dv, gram = _touched()
    strength = weight**2 * float(np.trace(gram)) / len(j)
    right = _minimiser(gram + np.eye(len(j), dtype=int) * Fraction(strength))
    naive = np.linalg.inv(j.T @ j + strength * np.diag(r)) @ (j.T @ dv)
    images = [_ours(dtype, weight, dv) for dtype in ("float64", "float32")] + [naive]
    double, single, plain = (float(np.abs(image - right).max() / np.abs(right).max()) for image in images)
    return double, single, plain


def _minimiser(matrix: np.ndarray) -> np.ndarray:
    j, r, dv, _ = _touched()
    fractions = np.array([Fraction(v) for v in dv.tolist()])
    return (j.T @ (inverse_corner(matrix, len(dv)) @ fractions).astype(float)) / r


def _ours(dtype: str, weight: float, dv: np.ndarray) -> np.ndarray:
    try:
        recon = je.prepare(_image_model(dtype), je.Tikhonov(), basis=_basis(dtype), hyperparameter=weight)
    except je.imaging.InverseError:
        return np.full(SIDE**2, np.nan)  # refused
    return np.asarray(recon(np.asarray(dv, dtype)), float)


def light_touch(strength: float) -> Errors:
    """Force on the map, regardless of sign, beyond what the pad feels, over that; the worst of many noises.

    The strength is the peak of the image over the noise of a pixel; naive: the paper's equation 4 as printed.
    """
    places = np.asarray(_basis("float64").centres)
    bump = strength * np.exp(-np.sum((places - [0.07, 0.12]) ** 2, 1) / (2 * 0.02**2))
    images = bump + np.random.default_rng(0).normal(size=(DRAWS, len(places)))
    naive = images / images.sum(1, keepdims=True)
    ours = [_fused(images, dtype) for dtype in ("float64", "float32")]
    double, single, plain = (float(np.abs(np.abs(f).sum(1) - 1).max()) for f in (*ours, naive))
    return double, single, plain


def _fused(images: np.ndarray, dtype: str) -> np.ndarray:
    masks = je.pad_masks(_image_skin(), _basis(dtype))
    return np.asarray(je.fuse(jnp.asarray(images, dtype), masks, jnp.ones((len(images), 1), dtype)).force, float)


def _decades(first: float, last: float, step: float) -> list[float]:
    count = round(abs(last - first) / step) + 1
    return (10.0 ** np.linspace(first, last, count)).tolist()


READING = "error of the worst reading"
SCHUR = "pseudo-inverse of Y"
GEOMETRY = "nodes in float32"
TOO_MUCH = "force too much"
SMALLEST, LEFT = "largest over smallest", "conductivity left"
AXES = [
    Axis("Contact resistance", "specific resistance, Ω m² or Ω m", SCHUR, READING,
         lambda z: read(FLAT, (z,) * 4), _decades(-12, 8, 1)),
    Axis("Contrast, each element its own", SMALLEST, SCHUR, READING,
         lambda ratio: read(_drawn(ratio)), _decades(0, 12, 1)),
    Axis("Contrast, smooth", SMALLEST, SCHUR, READING,
         lambda ratio: read(_wave(ratio)), _decades(0, 12, 1)),
    Axis("A tear amid the sheet", LEFT, "ground in the tear", READING,
         lambda left: read(_torn(left, 3), ground=(4.0, 2.0)), _decades(0, -18, 1)),
    Axis("A tear across the sheet", LEFT, SCHUR, READING,
         lambda left: read(_torn(left, np.inf)), _decades(0, -18, 1)),
    Axis("Graded mesh", "longest over shortest edge", GEOMETRY, READING,
         lambda ratio: _on_the_strip(strip.graded(0.02 / ratio)), _decades(1, 6, 1)),
    Axis("Slivers, unchecked", "smallest angle, degrees", GEOMETRY, READING,
         lambda angle: _on_the_strip(strip.capped(np.tan(np.radians(angle)) / 2**0.5)), _decades(1, -7, 1)),
    Axis("Regularisation", "λ", "inverse of JᵀJ + λ²R", "error of the image", regularisation, _decades(2, -10, 1)),
    Axis("Light touch", "peak over noise", "equation 4 as printed", TOO_MUCH, light_touch, _decades(2, -2, 0.25)),
]  # fmt: skip


def measure(axes: Sequence[Axis], per_axis: int | None = None) -> list[Row]:
    """All severities of each, or so many spread over them."""
    rows: list[Row] = []
    for axis in axes:
        count = len(axis.severities)
        picked = range(count) if per_axis is None else np.linspace(0, count - 1, per_axis).astype(int)
        rows += [axis.row(axis.severities[k]) for k in picked]
        print(f"{axis.title}: {rows[-1]}", flush=True)
    return rows


LOOKS: dict[str, Row] = {
    "float64": {"color": BLUE, "marker": "o", "label": "jaxeit, float64"},
    "float32": {"color": ORANGE, "marker": "s", "label": "jaxeit, float32"},
    "naive": {"color": "#9a9a9a", "marker": "D", "label": "naive, float64 (as each panel says)"},
}
LOST: Row = {"marker": "x", "linestyle": "none"}
LOWEST, HIGHEST = 1e-17, 1e3


def picture(data: Row) -> Figure:
    """A panel per axis; what is not finite at the upper edge."""
    figure, axes = panels(11.0, 9.6, 3, 3, sharey=True)
    rows = grouped(data["rows"], "axis")
    for panel, axis in zip(axes, AXES, strict=True):
        _panel(panel, axis, rows.get(axis.title, []))
    entries = [look | {"markersize": 4} for look in LOOKS.values()]
    legend(figure, [*entries, LOST | {"color": GREY, "label": "not finite, or refused"}], 4, size=9)
    return figure


def _panel(panel: Any, axis: Axis, rows: list[Row]) -> None:
    panel.set(xscale="log", yscale="log", ylim=(LOWEST, 10 * HIGHEST), xlabel=axis.severity)
    panel.set_title(axis.title, fontsize=10.5, pad=17)
    panel.text(0.5, 1.025, f"naive: {axis.naive}", transform=panel.transAxes, fontsize=8, ha="center", color="#666666")
    panel.minorticks_off()
    panel.grid(True, which="major", color="#e8e8e8", linewidth=0.8)
    panel.axhspan(1, 10 * HIGHEST, color="#f6eded", zorder=0)
    for form, look in reversed(LOOKS.items()):
        finite = [np.nan if row[form] is None else np.clip(row[form], LOWEST * 1.6, HIGHEST) for row in rows]
        panel.plot([row["severity"] for row in rows], finite, **look, markersize=3.6, linewidth=1.3)
        lost = [row["severity"] for row in rows if row[form] is None]
        panel.plot(lost, [3 * HIGHEST] * len(lost), **LOST, color=look["color"], markersize=5)
    if axis.severities[0] > axis.severities[-1]:
        panel.invert_xaxis()
    if panel.get_subplotspec().is_first_col() or axis.error != READING:
        panel.set_ylabel(axis.error, fontsize=9)


def every(run: Run) -> Iterator[Row]:
    yield {"rows": measure(AXES, 2 if run.smoke else None)}


main = Question("stability", __doc__, {"rows": every}, picture=picture, file="stability.png")

if __name__ == "__main__":
    main()
