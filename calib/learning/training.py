"""Training of the network: what it is told for its outputs, and epochs that go on after an interruption."""

import hashlib
import io
from collections.abc import Callable
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from jaxeit.contacts import LoadKind
from jaxeit.contacts.loads.learned import KINDS, LAYERS, PARAMETERS, SHAPES, loads_by_kind

from ..bench import BenchError
from ..session import replacing

WIDTH = 320  # of the hidden layers
BATCH, RATE, DECAY = 256, 2e-3, 1e-4
# Shares of the frames of a batch that lack an electrode, all pads, and each pad.
DEAD_ELECTRODE, NO_PADS, DEAD_PAD = 0.2, 0.2, 0.05
# Errors of x, y, log width, log force, and half an edge in x and y that count as one.
TOLERANCES = (0.004, 0.004, 0.3, 0.3, 0.004, 0.004)
PLACES = 1.0  # weight of the errors of loads against that of kinds


class Examples(NamedTuple):
    """Frames to learn from.

    | meaning                                                          | shape            |
    |------------------------------------------------------------------|------------------|
    | whole, damaged: inputs of all readings, and without an electrode | (n, r + 1) each  |
    | pads: forces as inputs, known flags                              | (n, pads) each   |
    | kind                                                             | (n,)             |
    | loads in units of the outputs, and of which kinds they are known | (n, 30), (n, 4)  |
    """

    whole: Float[Array, "n i"]
    damaged: Float[Array, "n i"]
    pads: Float[Array, "n p"]
    kind: Int[Array, " n"]
    loads: Float[Array, "n 30"]
    known: Float[Array, "n 4"]


class TrainingState(NamedTuple):
    """Weights, what the optimiser keeps, and the number of epochs done."""

    network: eqx.nn.MLP
    optimiser: optax.OptState
    epochs: Int[Array, ""]


def new_network(inputs: int, key: PRNGKeyArray) -> eqx.nn.MLP:
    """A network with random weights."""
    return eqx.nn.MLP(inputs, KINDS + PARAMETERS, WIDTH, LAYERS - 1, dtype=jnp.float32, key=key)


def train(
    examples: Examples,
    tolerance: Float[np.ndarray, " 30"],
    epochs: int,
    seed: int,
    checkpoint: Path,
    tell: Callable[[int], object],
) -> eqx.nn.MLP:
    """Train for so many epochs, from the checkpoint if there is one; equal arguments give equal weights.

    Args:
        tolerance: errors of the outputs that count as one.
        tell: called after each epoch with its number.

    Raises:
        BenchError: the checkpoint is damaged, or the weights are no numbers after an epoch.
    """
    key = jax.random.key(seed)
    steps = len(examples.kind) // BATCH
    optimiser = optax.adamw(optax.cosine_decay_schedule(RATE, epochs * steps), weight_decay=DECAY)
    network = new_network(examples.whole.shape[1] + 2 * examples.pads.shape[1], key)
    state = TrainingState(network, optimiser.init(eqx.filter(network, eqx.is_array)), jnp.asarray(0))
    if checkpoint.is_file():
        state = _read(checkpoint, state)
    run = eqx.filter_jit(epoch)
    while int(state.epochs) < epochs:
        number = int(state.epochs)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies numbers of several types
            state, _ = run(state, optimiser, examples, jnp.asarray(tolerance), jax.random.fold_in(key, number))
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(eqx.filter(state.network, eqx.is_array))):
            raise BenchError(f"the weights are no numbers after epoch {number + 1}; give another seed or more frames")
        _write(checkpoint, state)
        tell(number + 1)
    return state.network


def _write(checkpoint: Path, state: TrainingState) -> None:
    """Write a state, with the digest that tells whether it is whole."""
    buffer = io.BytesIO()
    eqx.tree_serialise_leaves(buffer, state)
    with replacing(checkpoint) as new:
        new.write_bytes(hashlib.sha256(buffer.getvalue()).digest() + buffer.getvalue())


def _read(checkpoint: Path, like: TrainingState) -> TrainingState:
    """Read what `_write` wrote of a state of these shapes."""
    whole = checkpoint.read_bytes()
    size = hashlib.sha256().digest_size
    if whole[:size] != hashlib.sha256(whole[size:]).digest():
        raise BenchError(f"{checkpoint} is damaged; remove it, and training begins anew on the scenes beside it")
    state: TrainingState = eqx.tree_deserialise_leaves(io.BytesIO(whole[size:]), like)
    return state


def epoch(
    state: TrainingState,
    optimiser: optax.GradientTransformation,
    examples: Examples,
    tolerance: Float[Array, " 30"],
    key: Key[Array, ""],
) -> tuple[TrainingState, Float[Array, ""]]:
    """One pass over all examples in a drawn order, and its mean loss."""
    weights, rest = eqx.partition(state.network, eqx.is_array)
    count = len(examples.kind) // BATCH
    orders = jax.random.permutation(key, len(examples.kind))[: count * BATCH].reshape(count, BATCH)

    def step(carry: tuple[Any, Any], at: tuple[Array, Array]) -> tuple[tuple[Any, Any], Array]:
        weights, kept = carry
        rows, key = at
        batch = jax.tree.map(lambda part: part[rows], examples)
        x = drawn_inputs(batch, key)
        loss, slopes = jax.value_and_grad(lambda w: mean_loss(eqx.combine(w, rest), x, batch, tolerance))(weights)
        change, kept = optimiser.update(slopes, kept, weights)
        return (optax.apply_updates(weights, change), kept), loss

    keys = jax.random.split(jax.random.fold_in(key, 1), count)
    (weights, kept), losses = jax.lax.scan(step, (weights, state.optimiser), (orders, keys))
    return TrainingState(eqx.combine(weights, rest), kept, state.epochs + 1), jnp.mean(losses)


def drawn_inputs(batch: Examples, key: Key[Array, ""]) -> Float[Array, "n i"]:
    """Inputs of a batch, some of them without an electrode or without pads."""
    keys = jax.random.split(key, 3)
    dead = jax.random.bernoulli(keys[0], DEAD_ELECTRODE, (len(batch.kind), 1))
    lost = jax.random.bernoulli(keys[1], NO_PADS, (len(batch.kind), 1))
    lost |= jax.random.bernoulli(keys[2], DEAD_PAD, batch.pads.shape)
    known = jnp.where(lost, 0, jnp.ones_like(batch.pads))
    return jnp.concatenate([jnp.where(dead, batch.damaged, batch.whole), batch.pads * known, known], 1)


def mean_loss(
    network: eqx.nn.MLP, x: Float[Array, "n i"], batch: Examples, tolerance: Float[Array, " 30"]
) -> Float[Array, ""]:
    """Cross-entropy of the kinds, and errors of the loads of each kind in the order that suits best."""
    outputs = jax.vmap(network)(x)
    logs = jax.nn.log_softmax(outputs[:, :KINDS])
    kinds = -jnp.take_along_axis(logs, batch.kind[:, None], 1)[:, 0]
    errors = load_errors(outputs[:, KINDS:], batch.loads, tolerance)
    return jnp.mean(kinds + PLACES * jnp.sum(batch.known * errors, 1) / len(SHAPES))


def load_errors(
    found: Float[Array, "n 30"], true: Float[Array, "n 30"], tolerance: Float[Array, " 30"]
) -> Float[Array, "n 4"]:
    """Pseudo-Huber errors of the loads of each kind: for any order of the loads, for either end of an edge first."""
    errors, apart = [], [loads_by_kind(values) for values in (found, true, tolerance)]
    for kind, (rows, size) in SHAPES.items():
        one, other, unit = (values[kind] for values in apart)
        if kind is LoadKind.EDGE:
            orders = [other, other * jnp.where(jnp.arange(size) < 4, 1, -1).astype(other.dtype)]
        else:
            orders = [other[:, list(order)] for order in permutations(range(rows))]
        each = [jnp.mean(jnp.sum(jnp.sqrt(1 + ((one - o) / unit) ** 2) - 1, 2), 1) for o in orders]
        errors.append(jnp.min(jnp.stack(each), 0))
    return jnp.stack(errors, 1)
