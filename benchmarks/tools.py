"""The tools that are compared, as data: for each kind of work those that do it, their preparation and their limits.

All get the same mesh, conductivity and pairs, and are called with NumPy arrays that give NumPy arrays.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve

import jaxeit as je

from .clock import MAX_DIFFERENCE, Tool, seconds
from .peers import adjoint, cholmod, eidors, pyeit, superlu
from .problems import Problem
from .processes import InProcesses

PIXELS = 30
HYPERPARAMETER = 0.1
PRIOR = je.Noser(floor=1e-12)  # the others know no floor; ours would lift the pixels in the corners
FRAMES = 100  # of the pipeline
CONTACTS = 64  # of a call with many, a multiple of every batch
MAX_FLOAT32_DIFFERENCE = 1e-2  # single precision: how far it is off is reported, not required to be nothing
MAX_IMAGE_DIFFERENCE = 1e-7
IN_DATA, IN_IMAGE = "by hand in data space", "by hand in image space"


@dataclass(frozen=True, eq=False)
class Entry:
    """A tool at some work: its name in the results, how it is prepared for a problem, and its limits.

    ``largest``: cells a side beyond which it takes minutes or gigabytes. ``loose``: how far its results may be off.
    """

    name: str
    prepare: Callable[[Problem], Tool]
    peer: ModuleType | None = None
    largest: int = 240
    loose: float = MAX_DIFFERENCE

    def absent(self, cells: int) -> str | None:
        """Why the tool does not run at this size."""
        if self.peer is not None and self.peer.missing():
            return self.peer.missing()
        return f"beyond {self.largest} cells a side it takes too long" if cells > self.largest else None


def present(entries: Sequence[Entry], cells: int) -> list[Entry]:
    """Those that run at this size; says which do not, and why."""
    for entry in entries:
        if reason := entry.absent(cells):
            print(f"{entry.name} left out: {reason}")
    return [entry for entry in entries if not entry.absent(cells)]


def compiled(function: Callable, model: je.Model, *extra: Any, options: Mapping[str, Any] | None = None) -> Callable:
    """``function(model, sigma, *extra)`` under one jit, with no compiler options but these; a function of sigma."""
    run = je.bind(lambda model, extra, sigma: function(model, sigma, *extra), model, extra, options=options or {})
    return lambda sigma: jax.block_until_ready(run(sigma))


def as_tool(run: Callable, dtype: str = "float64") -> Tool:
    """A jitted function as the other tools are: NumPy in, NumPy out, transfers included."""
    return lambda sigma: np.asarray(run(np.asarray(sigma, dtype)))


# --- forward solves


def forward(problem: Problem, dtype: str = "float64", order: int = 1) -> Tool:
    return forward_of(problem.model(dtype, order), dtype)


def forward_of(model: je.Model, dtype: str) -> Tool:
    return as_tool(compiled(je.forward, model, options=je.compiler_options()), dtype)


def forward_inside(problem: Problem) -> Tool:
    """As part of a program that was not given `je.compiler_options`."""
    return as_tool(compiled(je.forward, problem.model()))


def forward_called(problem: Problem) -> Tool:
    """As users call it: `je.forward(model, sigma)`."""
    return as_tool(partial(je.forward, problem.model()))


FORWARD = (
    Entry("jaxeit float64", forward),
    Entry("jaxeit float32", partial(forward, dtype="float32"), loose=MAX_FLOAT32_DIFFERENCE),
    Entry("jaxeit float64, called from Python", forward_called),
    Entry("jaxeit float64, without compiler options", forward_inside),
    Entry(superlu.NAME, superlu.prepare, superlu),
    Entry(cholmod.NAME, cholmod.prepare, cholmod),
    Entry(pyeit.NAME, pyeit.prepare, pyeit, largest=120),
    Entry(eidors.NAME, eidors.Eidors, eidors),
)


# --- Jacobians


def basis_of(model: je.Model, pixels: bool) -> je.model.BasisMap:
    return (je.Pixels(PIXELS) if pixels else je.Elements()).on(model)


def jacobian(problem: Problem, pixels: bool, dtype: str = "float64", *, options: bool = True) -> Tool:
    model, chosen = problem.model(dtype), je.compiler_options() if options else None
    return as_tool(compiled(je.jacobian, model, basis_of(model, pixels), options=chosen), dtype)


def projection(problem: Problem, pixels: bool = True) -> sp.csr_array | None:
    """(elements, 900): pixels as a matrix, for the tools that are given it; None onto elements."""
    if not pixels:
        return None
    image = basis_of(problem.model(), True)
    weight, element = np.asarray(image.weight), np.asarray(image.element)
    coefficient = np.broadcast_to(np.asarray(image.coefficient)[:, None], element.shape)
    entries = weight.ravel(), (element.ravel(), coefficient.ravel())
    return sp.csr_array(entries, shape=(len(problem.sigma), image.size))


def jacobian_by_hand(problem: Problem, pixels: bool) -> Tool:
    return adjoint.prepare(problem, projection(problem, pixels))


def by_eidors(problem: Problem, pixels: bool, verb: str) -> eidors.Eidors:
    """EIDORS at a verb of `peers.eidors`, onto pixels or elements."""
    extra: dict[str, Any] = {} if verb == "jacobian" else {"hyperparameter": strength(problem, pixels) ** 0.5}
    if verb == "pipeline":
        extra["frames"] = frames(len(problem.pattern))
    return eidors.Eidors(problem, verb, pixels=projection(problem, pixels), **extra)


def onto(name: str, prepare: Callable[..., Tool], *rest: Any, elements: int = 240, **more: Any) -> tuple[Entry, Entry]:
    """A tool onto pixels and onto elements, up to so many cells a side; the names say which."""
    pixels = Entry(f"{name}, pixels", partial(prepare, pixels=True), *rest, **more)
    return pixels, Entry(f"{name}, elements", partial(prepare, pixels=False), *rest, largest=elements, **more)


JACOBIAN = (
    *onto("jaxeit float64", jacobian, elements=120),  # beyond, the matrix alone takes 1.3 GB
    onto("jaxeit float64, without compiler options", partial(jacobian, options=False))[0],
    onto("jaxeit float32", partial(jacobian, dtype="float32"), loose=MAX_FLOAT32_DIFFERENCE)[0],
    *onto(adjoint.NAME, jacobian_by_hand, elements=120),
    Entry(f"{pyeit.NAME}, elements", pyeit.prepare_jacobian, pyeit, 30),  # it inverts a dense matrix
    *onto(eidors.NAME, partial(by_eidors, verb="jacobian"), eidors, elements=120),
)


# --- gradients of a loss


def loss(model: je.Model, sigma: jax.Array) -> jax.Array:
    """Half the sum of squares of the voltages."""
    return 0.5 * jnp.sum(je.forward(model, sigma) ** 2)


def gradient(problem: Problem, dtype: str = "float64", *, options: bool = True) -> Tool:
    """The gradient of `loss`, in V^2/S."""
    run = compiled(jax.grad(loss, 1), problem.model(dtype), options=je.compiler_options() if options else None)
    return as_tool(run, dtype)


GRADIENT = (
    Entry("jaxeit float64", gradient),
    Entry("jaxeit float32", partial(gradient, dtype="float32"), loose=MAX_FLOAT32_DIFFERENCE),
    Entry("jaxeit float64, without compiler options", partial(gradient, options=False)),
    Entry(adjoint.NAME, adjoint.prepare_gradient),
)


# --- reconstructions: from conductivity to what turns frames into images


def reconstructor(model: je.Model, basis: je.model.BasisMap, sigma: jax.Array) -> je.Reconstructor:
    return je.prepare(model, PRIOR, basis=basis, hyperparameter=HYPERPARAMETER, sigma=sigma)


class Reconstruction:
    """`prepare`, whose clock stops when the reconstructor is there; Q is written out for comparison only."""

    def __init__(self, problem: Problem, pixels: bool, dtype: str = "float64") -> None:
        self.dtype, self.model = dtype, problem.model(dtype)
        self.basis = basis_of(self.model, pixels)

    def __call__(self, sigma: np.ndarray) -> np.ndarray:
        self.last_seconds, recon = seconds(self.reconstructor, sigma)
        return np.asarray(recon.matrix)

    def reconstructor(self, sigma: np.ndarray) -> je.Reconstructor:
        return jax.block_until_ready(reconstructor(self.model, self.basis, jnp.asarray(sigma, self.dtype)))


def noser(j: np.ndarray) -> tuple[np.ndarray, float]:
    """R = diag(J^T J)^0.5, and l^2 = hyperparameter^2 tr(J R^-1 J^T) / readings, of which the trace is that of R."""
    prior = np.sqrt(np.einsum("ij,ij->j", j, j))
    return prior, HYPERPARAMETER**2 * prior.sum() / len(j)


def in_data_space(j: np.ndarray) -> np.ndarray:
    """``R^-1 J^T (J R^-1 J^T + l^2 I)^-1``."""
    prior, square = noser(j)
    gained = j / prior
    small = gained @ j.T
    np.einsum("ii->i", small)[:] += square
    return cho_solve(cho_factor(small, overwrite_a=True), gained).T


def in_image_space(j: np.ndarray) -> np.ndarray:
    """``(J^T J + l^2 R)^-1 J^T``."""
    prior, square = noser(j)
    small = j.T @ j
    np.einsum("ii->i", small)[:] += square * prior
    return cho_solve(cho_factor(small, overwrite_a=True), j.T)


def inverse_by_hand(problem: Problem, pixels: bool, solve: Callable = in_data_space) -> Tool:
    matrix = jacobian_by_hand(problem, pixels)
    return lambda sigma: solve(matrix(sigma))


def strength(problem: Problem, pixels: bool = False) -> float:
    """l^2, which the others are given as a number."""
    return noser(jacobian_by_hand(problem, pixels)(problem.sigma))[1]


def inverse_by_pyeit(problem: Problem) -> Tool:
    return pyeit.prepare_inverse(problem, strength(problem))


LOOSE: dict[str, Any] = {"loose": MAX_IMAGE_DIFFERENCE}
DENSE = LOOSE | {"elements": 60}  # a dense system elements x elements takes minutes
INVERSE = (
    *onto("jaxeit float64", Reconstruction, **DENSE),
    *onto(IN_DATA, inverse_by_hand, **DENSE),
    onto(IN_IMAGE, partial(inverse_by_hand, solve=in_image_space), **LOOSE)[0],
    *onto(eidors.NAME, partial(by_eidors, verb="inverse"), eidors, **DENSE),
    Entry(f"{pyeit.NAME}, elements", inverse_by_pyeit, pyeit, largest=60, **LOOSE),
)


# --- the whole way: from the mesh to images of frames


@cache
def frames(readings: int) -> np.ndarray:
    """(readings, 100)."""
    return np.random.default_rng(0).normal(size=(readings, FRAMES))


def pipeline(problem: Problem, pixels: bool) -> Tool:
    """`discretise`, `prepare` and images, from arrays to arrays."""
    seen, _ = frames(len(problem.pattern)).T, problem.mesh  # at hand before the clock starts

    def images(sigma: np.ndarray) -> np.ndarray:
        model = problem.model()
        return np.asarray(reconstructor(model, basis_of(model, pixels), jnp.asarray(sigma))(seen)).T

    return images


def pipeline_by_hand(problem: Problem, pixels: bool) -> Tool:
    """The adjoint formula and SciPy's Cholesky, prepared for the mesh in each call."""
    project, seen = projection(problem, pixels), frames(len(problem.pattern))
    return lambda sigma: in_image_space(adjoint.prepare(problem, project)(sigma)) @ seen


def pipeline_by_pyeit(problem: Problem) -> Tool:
    return pyeit.prepare_pipeline(problem, strength(problem), frames(len(problem.pattern)))


SLOW = LOOSE | {"elements": 30}
PIPELINE = (
    *onto("jaxeit float64", pipeline, **SLOW),
    *onto(IN_IMAGE, pipeline_by_hand, **SLOW),
    *onto(eidors.NAME, partial(by_eidors, verb="pipeline"), eidors, **SLOW),
    Entry(f"{pyeit.NAME}, elements", pipeline_by_pyeit, pyeit, largest=30, **LOOSE),
)

# --- many contacts in one call


def contacts(problem: Problem) -> np.ndarray:
    """(CONTACTS, elements): by how much Gaussian contacts (width 12 mm, half as much again) raise conductivity, each
    alone on the sheet, at places all over the grid of 41 x 41 whose pitch is 5 mm."""
    numbers = np.linspace(0, 41**2 - 1, CONTACTS).astype(int)
    offset = problem.mesh.chart_centroids - 0.005 * np.stack([numbers % 41, numbers // 41], 1)[:, None]
    return 1 + 0.5 * np.exp(-0.5 * np.sum(offset**2, -1) / 0.012**2)


def batched(problem: Problem, batch: int, dtype: str = "float64") -> Tool:
    """Voltages with each of the contacts, (CONTACTS, readings), so many at a time."""

    def several(model: je.Model, sigma: jax.Array) -> jax.Array:
        return jax.lax.map(lambda one: je.forward(model, one), sigma, batch_size=batch)

    tool = as_tool(compiled(several, problem.model(dtype), options=je.compiler_options()), dtype)
    shapes = contacts(problem)
    return lambda sigma: tool(shapes * sigma)


def shared_out(problem: Problem, dtype: str = "float64") -> Tool:
    """Voltages with each of the contacts, (CONTACTS, readings), a share on each device of JAX."""
    many, shapes = je.bind_many(je.forward, problem.model(dtype)), contacts(problem)
    return lambda sigma: np.asarray(many((shapes * sigma).astype(dtype)))


def share(prepare: Callable[[Problem], Tool], problem: Problem, number: int, count: int) -> Tool:
    """The tool for one of ``count`` equal shares of the contacts."""
    tool, shapes = prepare(problem), np.array_split(contacts(problem), count)[number]
    return lambda sigma: np.stack([tool(one) for one in shapes * sigma])


def one_by_one(prepare: Callable[[Problem], Tool]) -> Callable[[Problem], Tool]:
    return lambda problem: share(prepare, problem, 0, 1)


def in_processes(prepare: Callable[[Problem], Tool]) -> Callable[[Problem], Tool]:
    """A tool in as many processes as there are cores, each with its share of the contacts at hand."""
    return lambda problem: InProcesses(partial(share, prepare, Problem(problem.cells)))  # without what is cached


ALL_CORES = f"batches of {CONTACTS}, all cores"

BATCH = (
    *(Entry(f"jaxeit float64, batches of {n}", partial(batched, batch=n)) for n in (1, 8, CONTACTS)),
    *(
        Entry(
            f"jaxeit float32, batches of {n}", partial(batched, batch=n, dtype="float32"), loose=MAX_FLOAT32_DIFFERENCE
        )
        for n in (8, CONTACTS)
    ),
    Entry(f"jaxeit float64, {ALL_CORES}", shared_out),
    Entry(f"jaxeit float32, {ALL_CORES}", partial(shared_out, dtype="float32"), loose=MAX_FLOAT32_DIFFERENCE),
    Entry(superlu.NAME, one_by_one(superlu.prepare), superlu),
    Entry(cholmod.NAME, one_by_one(cholmod.prepare), cholmod),
    Entry(f"{cholmod.NAME}, forward substitution only, all cores", in_processes(cholmod.prepare_substituted), cholmod),
)

TOOLS = {
    "forward": FORWARD,
    "jacobian": JACOBIAN,
    "gradient": GRADIENT,
    "inverse": INVERSE,
    "pipeline": PIPELINE,
    "batch": BATCH,
}
