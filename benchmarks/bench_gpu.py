"""A GPU at forward solves, Jacobians, gradients, images, contacts, training and the ladder, in both precisions.

Conductivities lie on the device before a call, and results stay there. Before a clock is read, voltages are compared
with those of SuperLU in float64 on the host; Jacobians and gradients with ours in float64 on the CPU; images and
contacts with ours there. Beside ours stand cuDSS, NVIDIA's direct solver for sparse matrices, which factors a batch of
one pattern (where it is installed: ``pip install nvidia-cudss-cu13``), and dense matrices factored by the libraries
that JAX calls (cuSOLVER, cuBLAS).

Without a GPU it says so. With ``--smoke`` it runs on a CPU as well.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.learning import training
from jaxeit.linalg import Dense

from .clock import Program, difference, in_turns, program, seconds
from .harness import Question, Run
from .peers import cudss, superlu
from .problems import SMOKE, Problem
from .rows import Row
from .tools import MAX_FLOAT32_DIFFERENCE, basis_of

LOOSE = {"float32": MAX_FLOAT32_DIFFERENCE, "float64": 1e-8}
CHECKED = 3  # conductivities of a batch whose voltages are compared
LARGEST_DENSE = 30  # cells a side
LADDER = (
    "draft",
    "draft f32",
    "draft P2",
    "draft P2 f32",
    "standard",
    "standard f32",
    "fine",
    "reference f32",
    "reference",
)
RUNG = ("label", "nodes", "unknowns", "voltage_error", "difference_error", "forward", "jacobian")


@cache
def problem_of(cells: int) -> Problem:
    return Problem(cells)


@cache
def model_of(cells: int, dtype: str, dense: bool = False) -> je.Model:
    problem = problem_of(cells)
    if not dense:
        return problem.model(dtype)
    return je.discretise(je.Scene(problem.skin), je.Fidelity(dtype=dtype, solver=Dense()), mesh=problem.mesh)


def conductivities(cells: int, batch: int, dtype: str) -> jax.Array:
    """(batch, elements); no two are alike."""
    problem = problem_of(cells)
    x, y = (problem.mesh.chart_centroids / 0.2).T
    rng = np.random.default_rng(batch)
    centre = rng.uniform(0.1, 0.9, (batch, 2, 1))
    press = np.exp(-((x - centre[:, 0]) ** 2 + (y - centre[:, 1]) ** 2) / 0.01)
    return jnp.asarray(problem.sigma * (1 + 0.5 * press), dtype)


def median_ms(call: Callable, repeats: int, budget: float) -> float:
    return 1e3 * float(np.median(in_turns({0: call}, repeats, budget)[0]))


def row(call: Callable, what: str, dtype: str, batch: int, off: float, repeats: int, budget: float = 2.0) -> Row:
    """Times of a call for a batch, whose results are off by so much of the largest value."""
    if not off <= LOOSE[dtype]:
        raise SystemExit(f"{what}, {dtype}: off by {off:.1e} of the largest value; nothing is timed")
    ms = median_ms(call, repeats, budget)
    about: Row = {"what": what, "dtype": dtype, "batch": batch, "difference": off}
    return about | {"median_ms": ms, "per_s": 1e3 * batch / ms}


def size(cells: int) -> Row:
    return {"nodes": len(problem_of(cells).mesh.nodes)}


def each(function: Callable, batch: jax.Array) -> Any:
    """The results for a batch; of one, by the function itself."""
    if len(batch) == 1:
        return jax.tree.map(lambda a: a[None], function(batch[0]))
    return jax.vmap(function)(batch)


def cost(found: Program) -> Row:
    """What a program takes before it runs, and in memory."""
    memory = found.compiled.memory_analysis()
    used = (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 1e6
    return {"compile_s": found.compile_s, "memory_mb": used}


# --- what is computed: for a model, and one conductivity


def gradient(model: je.Model, sigma: jax.Array) -> jax.Array:
    """Of half the sum of squared voltages."""
    return jax.grad(lambda s: 0.5 * jnp.sum(je.forward(model, s) ** 2))(sigma)


def pixel_jacobian(model: je.Model, sigma: jax.Array, basis: je.model.BasisMap) -> jax.Array:
    return je.jacobian(model, sigma, basis)


def exact(what: str, cells: int, sigma: np.ndarray) -> np.ndarray:
    """The result for one conductivity, in float64 on the host."""
    if what == "forward":
        return superlu.prepare(problem_of(cells))(sigma)
    with jax.default_device(jax.devices("cpu")[0]):
        model = Problem(cells).model()  # its arrays lie on the CPU
        extra = (basis_of(model, True),) if what == "Jacobian" else ()
        return np.asarray(WHAT[what](model, jnp.asarray(sigma), *extra))


WHAT: dict[str, Callable] = {"forward": je.forward, "Jacobian": pixel_jacobian, "gradient": gradient}


def measured(what: str, cells: int, dtype: str, batch: int, repeats: int, dense: bool = False) -> Row:
    model = model_of(cells, dtype, dense)
    sigma = conductivities(cells, batch, dtype)
    extra = (basis_of(model, True),) if what == "Jacobian" else ()

    def several(model: je.Model, sigma: jax.Array, *extra: Any) -> jax.Array:
        return each(lambda one: WHAT[what](model, one, *extra), sigma)

    found = program(several, (model, sigma, *extra))
    out = found.call()
    chosen = np.unique(np.linspace(0, batch - 1, CHECKED).astype(int)) if what == "forward" else [batch - 1]
    off = max(difference(np.asarray(out[k], float), exact(what, cells, np.asarray(sigma[k], float))) for k in chosen)
    return size(cells) | row(found.call, what, dtype, batch, off, repeats) | cost(found)


# --- parts


def limits(run: Run) -> Iterator[Row]:
    """What the device reaches: flop/s of a product in full precision, byte/s of a copy; best of five."""
    device = jax.devices()[0]
    if device.platform == "cpu" and not run.smoke:
        raise SystemExit('JAX has no other device than CPUs; on a machine with a GPU, pip install "jax[cuda13]"')
    found: Row = {}
    size = 256 if run.smoke else 8192
    for dtype in LOOSE:
        a = jax.random.normal(jax.random.key(0), (size, size), dtype)
        product = jax.jit(partial(jnp.matmul, precision="highest"))
        found[f"{dtype}_flop_per_s"] = 2 * size**3 / best(lambda product=product, a=a: product(a, a))
    copied = jax.random.normal(jax.random.key(0), (size * size * 4,), "float32")
    copy = jax.jit(lambda x: x + 1)
    found["byte_per_s"] = 2 * copied.nbytes / best(lambda: copy(copied))
    yield {"device": device.device_kind, "limits": found}


def best(call: Callable[[], jax.Array]) -> float:
    jax.block_until_ready(call())
    return min(seconds(lambda: jax.block_until_ready(call()))[0] for _ in range(5))


def singles(run: Run) -> Iterator[Row]:
    """One conductivity at a time."""
    yield {"singles": []}
    for cells in run.sizes((30, 60, 120), (SMOKE,)):
        for what in WHAT:
            for dtype in LOOSE:
                yield {"singles": [measured(what, cells, dtype, 1, 20)]}


def batches(run: Run) -> Iterator[Row]:
    yield {"batches": []}
    for cells in run.sizes((30, 60, 120), (SMOKE,)):
        for dtype in LOOSE:
            for batch in run.sizes((64, 1024, 4096) if cells < 120 else (1024,), (1, 32)):
                yield {"batches": [measured("forward", cells, dtype, batch, 10)]}


def gradients(run: Run) -> Iterator[Row]:
    yield {"gradients": []}
    for cells in run.sizes((30, 60), (SMOKE,)):
        for what in ("gradient", "Jacobian"):
            for dtype in LOOSE:
                yield {"gradients": [measured(what, cells, dtype, run.sizes((256,), (32,))[0], 5)]}


def peers(run: Run) -> Iterator[Row]:
    """Other solvers at the same batches."""
    yield {"peers": []}
    if reason := cudss.missing():
        print(f"{cudss.NAME} left out: {reason}")
    for cells in run.sizes((30, 60), (SMOKE,)):
        for dtype in LOOSE:
            for batch in run.sizes((64, 1024, 4096), (32,)):
                if not cudss.missing():
                    yield {"peers": [by_cudss(cells, dtype, batch)]}
                if cells <= LARGEST_DENSE and batch <= 1024:
                    yield {"peers": [{"tool": "dense, cuSOLVER"} | measured("forward", cells, dtype, batch, 5, True)]}


def by_cudss(cells: int, dtype: str, batch: int) -> Row:
    sigma = conductivities(cells, batch, dtype)
    prepare_s, tool = seconds(cudss.Forward, problem_of(cells), batch, dtype)
    out = tool(sigma)
    off = difference(np.asarray(out[-1], float), exact("forward", cells, np.asarray(sigma[-1], float)))
    found = {"tool": cudss.NAME} | size(cells) | row(lambda: tool(sigma), "forward", dtype, batch, off, 10, 3.0)
    found |= {"solver_ms": median_ms(partial(tool.batch.solve, tool.assembled(sigma)), 10, 3.0)}
    tool.batch.close()
    return found | {"prepare_s": prepare_s}


def frames(run: Run) -> Iterator[Row]:
    """Images and contacts of the frames of the testbed, with an instance of each that was prepared on the host."""
    yield {"frames": []}
    batches = run.sizes((1, 1024), (1, 4))
    for dtype in LOOSE:
        with jax.default_device(jax.devices("cpu")[0]):
            dv, noise, model = touched(max(batches), dtype)
            prepared = {"image": je.prepare(model), "contacts": je.prepare_contacts(model, noise=noise)}
            right = {what: [np.asarray(shown(made(dv[k]))) for k in range(CHECKED)] for what, made in prepared.items()}
        for what, made in prepared.items():
            made = jax.device_put(made, jax.devices()[0])
            for batch in batches:
                yield {"frames": [of_frames(what, made, jax.device_put(dv[:batch], jax.devices()[0]), right[what])]}


def touched(count: int, dtype: str) -> tuple[jax.Array, jax.Array, je.Model]:
    """(count, readings) differences of frames with one contact each, V, the noise of each reading, V, and the model."""
    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft(dtype=dtype))
    places = jnp.asarray(np.random.default_rng(0).uniform(0.04, 0.16, (count, 2)), dtype)
    v0 = je.forward(model)
    noise = jnp.full(len(v0), 1e-4 * jnp.abs(v0).max())

    def frame(key: jax.Array, place: jax.Array) -> jax.Array:
        bump = jnp.exp(-jnp.sum((model.centroids - place) ** 2, 1) / (2 * 0.01**2))
        return (
            je.forward(model, model.background * (1 + 0.4 * bump))
            - v0
            + noise * jax.random.normal(key, v0.shape, dtype)
        )

    keys = jax.random.split(jax.random.key(1), count)
    return jax.lax.map(lambda one: frame(*one), (keys, places)), noise, model


def shown(found: jax.Array | je.contacts.Contacts) -> jax.Array:
    """What is compared of a result: the image, or the place of the strongest contact."""
    return found if isinstance(found, jax.Array) else je.contacts.strongest(found)


def of_frames(what: str, made: Callable, dv: jax.Array, right: list[np.ndarray]) -> Row:
    """Times for so many frames; of the first few it is known what is right."""
    found = program(each, (made, dv))
    out, batch = found.call(), len(dv)
    first = [shown(jax.tree.map(lambda a, k=k: a[k], out)) for k in range(min(batch, CHECKED))]
    off = max(difference(np.asarray(one, float), right[k].astype(float)) for k, one in enumerate(first))
    return row(found.call, what, str(dv.dtype), batch, off, 10) | cost(found)


def learning(run: Run) -> Iterator[Row]:
    """Steps of training a proposal (`jaxeit train`) on random numbers, an epoch each."""
    count = training.BATCH * (200 if not run.smoke else 2)
    rng = np.random.default_rng(0)
    inputs, pads = 60, 4
    shapes = {"whole": (inputs,), "damaged": (inputs,), "pads": (pads,), "loads": (30,), "known": (4,)}
    drawn = {name: jnp.asarray(rng.normal(size=(count, *shape)), jnp.float32) for name, shape in shapes.items()}
    kind = jnp.asarray(rng.integers(0, training.KINDS, count))
    examples = training.Examples(kind=kind, **drawn)
    optimiser = training.optax.adamw(1e-3)
    network = training.new_network(inputs + 2 * pads, jax.random.key(0))
    state = training.TrainingState(network, optimiser.init(eqx.filter(network, eqx.is_array)), jnp.asarray(0))
    epoch = eqx.filter_jit(training.epoch)
    with jax.numpy_dtype_promotion("standard"):
        call = partial(epoch, state, optimiser, examples, jnp.ones(30), jax.random.key(1))
        first, _ = seconds(lambda: jax.block_until_ready(call()[1]))
        times = [seconds(lambda: jax.block_until_ready(call()[1]))[0] for _ in range(3)]
    steps = count // training.BATCH
    spent = float(np.median(times))
    yield {"training": [{"steps_per_s": steps / spent, "frames_per_s": count / spent, "first_epoch_s": first}]}


def ladder(run: Run) -> Iterator[Row]:
    """The rungs of the testbed's ladder: their errors and times on this device, without images."""
    named = {choice.label: replace(choice, imaging=None) for choice in je.accuracy.fidelity_choices()}
    labels = run.sizes(LADDER, LADDER[:2])
    reference = (je.Fidelity.standard(order=2), je.Fidelity.reference(order=2)) if run.smoke else None
    found = je.ladder(je.Scene(je.load_skin("testbed")), [named[label] for label in labels], reference=reference)
    print(found.table(), flush=True)
    yield {"ladder": [{k: row[k] for k in RUNG} for row in found.summary()["rungs"]]}


PARTS = {
    "limits": limits,
    "singles": singles,
    "batches": batches,
    "gradients": gradients,
    "peers": peers,
    "frames": frames,
    "training": learning,
    "ladder": ladder,
}
main = Question("gpu", __doc__, PARTS)

if __name__ == "__main__":
    main()
