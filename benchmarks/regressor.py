"""The regressor that the paper has in mind: readings and pad forces to a force map, its last layer adapted to a skin.

A trunk turns the inputs into features. The last layer turns these into the logarithm of the total force and the shares
of 400 pixels (softmax), so that all forces are positive and sum to the total. Its weights differ between skins:
``W = W0 + sum_k c_k W_k``, a mixed-effects model (Laird and Ware 1982, Biometrics 38). Training finds trunk, W0, W_k
and a code c for each of its skins; the scatter of these codes is the belief about the code of a new skin. The belief is
updated by recursive least squares, linearised anew at each press.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import calib
import jaxeit as je
from calib.bench import TrainingFrames
from calib.bench.training.scene_frames import SHARD_FRAMES
from calib.learning.inputs import Compression, calibrated_forces, fit_compression
from calib.learning.scenes import noise_of, scenes_for, training_bench
from jaxeit.contacts.loads.learned.proposal import components, standardised

PIXELS = je.Pixels(20)
WIDTH, FEATURES, MODES = 256, 64, 32  # of the hidden layers, of the last one, and ways in which skins differ
SKINS, FRAMES, STEPS = 8, 32, 10_000  # of a batch, of each of its skins, and batches
RATE, DECAY = 2e-3, 1e-4
NO_PADS, DEAD_PAD, NO_CODE = (
    0.4,
    0.1,
    0.3,
)  # shares of the training's frames that lack all pads, each pad, the skin's code
FORCE_ERROR = 0.15  # of the log force that counts as much as one nat of the pixels' shares
TOUCHED = 0.1  # N; less is no contact


class Regressor(eqx.Module):
    """Trunk, and the last layer: its mean (outputs, features + 1) and modes (k, outputs, features + 1)."""

    trunk: eqx.nn.MLP
    mean: jax.Array
    modes: jax.Array

    def __call__(self, x: jax.Array, code: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Logarithms of the total force, N, and of the pixels' shares, of inputs (..., i) on a skin of a code (k,)."""
        inner = jax.vmap(self.trunk)(x.reshape(-1, x.shape[-1]))
        features = jnp.pad(inner, ((0, 0), (0, 1)), constant_values=1).reshape(*x.shape[:-1], -1)
        outputs = features @ (self.mean + jnp.tensordot(code, self.modes, 1)).T
        # With all pads known, their sum is the force to begin with: the last input but one, if the last is 1.
        return outputs[..., 0] + x[..., -2] * x[..., -1], jax.nn.log_softmax(outputs[..., 1:])

    def maps(self, x: jax.Array, code: jax.Array) -> jax.Array:
        """Force maps (..., pixels), N."""
        force, shares = self(x, code)
        return jnp.exp(force)[..., None] * jnp.exp(shares)


class Examples(NamedTuple):
    """Frames of the training by skin: directions (s, n, r), forces on pads (s, n, p) N, shares (s, n, pixels), log
    force (s, n), and whether anything touches (s, n)."""

    seen: jax.Array
    pads: jax.Array
    shares: jax.Array
    force: jax.Array
    there: jax.Array


def drawn(skin: je.Skin, folder: Path, skins: int) -> TrainingFrames:
    """Frames of the scenes that `jaxeit train` draws, with force maps."""
    fidelity = je.Fidelity.draft(dtype="float32")
    bench = replace(training_bench(skin), seed=1)
    frame_set = calib.bench.FrameSet(bench, skins * SHARD_FRAMES, fidelity, PIXELS, scenes_for(skin, fidelity))
    calib.write_training_frames(frame_set, folder)
    return calib.open_training_frames(folder)


def seen_of(compression: Compression, dv: np.ndarray) -> np.ndarray:
    """Directions and log size of frames (n, readings) V."""
    z, _, _ = components(np.asarray(dv, float) / compression.noise, compression.basis, compression.spread)
    return standardised(z, compression.mean, compression.deviation)[0].astype(np.float32)


def inputs(seen: Any, pads: Any, known: Any) -> Any:
    """Inputs of the network from directions, forces on pads N, and which of these are known; NumPy or JAX."""
    put = np if isinstance(seen, np.ndarray) else jnp
    pads, known = put.where(known, put.maximum(pads, 0), 0), known.astype(seen.dtype)
    total = put.log(put.maximum(put.sum(pads, -1, keepdims=True), TOUCHED))
    every = put.min(known, -1, keepdims=True)
    return put.concatenate([seen, put.log1p(pads), known, total, every], -1).astype(seen.dtype)


def examples_of(frames: TrainingFrames, compression: Compression) -> Examples:
    by_skin = lambda a: jnp.asarray(a.reshape(-1, SHARD_FRAMES, *a.shape[1:]), jnp.float32)  # noqa: E731
    maps = frames["force_map"]
    total = maps.sum(1)
    seen = np.concatenate([seen_of(compression, skin["frames"]) for skin in frames.skins()])
    shares = maps / np.maximum(total, TOUCHED)[:, None]
    force = np.log(np.maximum(total, TOUCHED))
    return Examples(*map(by_skin, (seen, calibrated_forces(frames), shares, force, total > TOUCHED)))


def train(examples: Examples, steps: int = STEPS, seed: int = 0) -> tuple[Regressor, np.ndarray]:
    """The regressor and the codes (skins, k) of the training's skins."""
    keys = jax.random.split(jax.random.key(seed), 4)
    skins, _, wide = examples.seen.shape
    pixels, wide = examples.shares.shape[-1], wide + 2 * examples.pads.shape[-1] + 2
    put = partial(jax.random.normal, dtype=jnp.float32)
    shape = (1 + pixels, FEATURES + 1)
    network = Regressor(
        eqx.nn.MLP(wide, FEATURES, WIDTH, 2, final_activation=jnp.tanh, dtype=jnp.float32, key=keys[0]),
        put(keys[1], shape) / np.float32(FEATURES**0.5),
        put(keys[2], (MODES, *shape)) * np.float32(1e-2),
    )
    codes = 0.3 * put(keys[3], (skins, MODES))
    optimiser = optax.adamw(optax.cosine_decay_schedule(RATE, steps), weight_decay=DECAY)
    weights, rest = eqx.partition((network, codes), eqx.is_inexact_array)

    def step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        weights, kept = state
        loss, slope = jax.value_and_grad(lambda w: _loss(*eqx.combine(w, rest), examples, key))(weights)
        change, kept = optimiser.update(slope, kept, weights)
        return (optax.apply_updates(weights, change), kept), loss

    with jax.numpy_dtype_promotion("standard"):
        run = eqx.filter_jit(lambda state, keys: jax.lax.scan(step, state, keys))
        state = weights, optimiser.init(weights)
        for number, part in enumerate(jnp.split(jax.random.split(jax.random.key(seed + 1), steps), min(20, steps))):
            state, losses = run(state, part)
            print(f"training, part {number}: loss {float(losses.mean()):.4f}", flush=True)
    network, codes = eqx.combine(state[0], rest)
    return network, np.asarray(codes, float)


def _loss(network: Regressor, codes: jax.Array, examples: Examples, key: jax.Array) -> jax.Array:
    """Cross-entropy of the shares and error of the log force, of some frames of some skins, and the codes' prior."""
    keys = jax.random.split(key, 5)
    skins = jax.random.choice(keys[0], len(codes), (min(SKINS, len(codes)),), replace=False)
    rows = jax.random.randint(keys[1], (len(skins), FRAMES), 0, examples.force.shape[1])
    batch = Examples(*(part[skins[:, None], rows] for part in examples))
    lost = jax.random.bernoulli(keys[2], NO_PADS, (*rows.shape, 1))
    lost |= jax.random.bernoulli(keys[3], DEAD_PAD, batch.pads.shape)
    x = inputs(batch.seen, batch.pads, ~lost)
    # Some skins of a batch lack their code, so that the mean layer is good for a skin that nothing is known of.
    code = codes[skins] * jax.random.bernoulli(keys[4], 1 - NO_CODE, (len(skins), 1))
    force, shares = jax.vmap(network)(x, code)
    away = (force - batch.force) / np.float32(FORCE_ERROR)
    errors = -jnp.sum(batch.shares * shares, -1) + jnp.sqrt(1 + away**2)
    prior = jnp.mean(jnp.sum(code**2, -1)) / (2 * examples.force.shape[1])
    return jnp.sum(batch.there * errors) / jnp.sum(batch.there) + prior


# --- adaptation


class Belief(NamedTuple):
    """What is known of a skin's code: mean (k,), covariance (k, k), and that before any press."""

    mean: np.ndarray
    covariance: np.ndarray
    prior: np.ndarray

    def aged(self, share: float) -> "Belief":
        """After this share was forgotten, as `jaxeit.tracking.LearnedLayer.aged` forgets."""
        kept = 1 - share
        return self._replace(mean=kept * self.mean, covariance=self.prior + kept**2 * (self.covariance - self.prior))


class Errors(NamedTuple):
    """What the network errs by on a skin whose code it has, two in three times less: of the force on a pad, the part of
    this force and the part of all force; of the centre of the map along x and y, m."""

    force: float
    beside: float
    place: float

    def of(self, forces: np.ndarray) -> np.ndarray:
        """Standard deviations for forces on the pads (p,) N, and for the centre of the map, m."""
        squares = (self.force * forces) ** 2 + (self.beside * forces.sum()) ** 2 + 0.1**2
        return np.concatenate([np.sqrt(squares), np.full(2, self.place)])


class Adapted(NamedTuple):
    """A regressor with all that its adaptation needs.

    | meaning                                                     | shape          |
    |-------------------------------------------------------------|----------------|
    | network, compression                                        |                |
    | prior: scatter of the codes of the training's skins         |                |
    | masks: share of each pad in each pixel; centres of these, m | (p, n), (n, 2) |
    | errors                                                      |                |
    """

    network: Regressor
    compression: Compression
    prior: Belief
    masks: np.ndarray
    centres: np.ndarray
    errors: Errors

    def inputs(self, dv: np.ndarray, forces: np.ndarray | None = None) -> np.ndarray:
        """Inputs of frames (n, readings) V, and forces on pads (n, p) N; NaN or None: not known."""
        seen = seen_of(self.compression, dv)
        forces = np.full((len(seen), len(self.masks)), np.nan) if forces is None else forces
        return inputs(seen, np.nan_to_num(forces), np.isfinite(forces))

    def maps(self, belief: Belief, dv: np.ndarray, forces: np.ndarray | None = None) -> np.ndarray:
        """Force maps (n, pixels) N by the mean of a belief."""
        return np.asarray(_maps(self.network, self.inputs(dv, forces), belief.mean.astype(np.float32)), float)

    def told(self, belief: Belief, dv: np.ndarray, forces: np.ndarray, place: np.ndarray | None = None) -> Belief:
        """The belief after one press, whose forces on the pads (p,) N are told; and its place (2,) m, if it is known.

        What the network says of the readings alone is compared with what the pads say.
        """
        x, code = self.inputs(dv[None]), belief.mean
        count = len(forces) + (0 if place is None else 2)
        noise = self.errors.of(np.maximum(forces, 0))[:count]
        goal = np.r_[forces, np.zeros(2) if place is None else place][:count]
        for _ in range(2):
            said, slope = (np.asarray(a, float)[:count] for a in self._said(x, code.astype(np.float32)))
            within = slope @ belief.covariance @ slope.T + np.diag(noise**2)
            gain = np.linalg.solve(within, slope @ belief.covariance).T
            code = belief.mean + gain @ (goal - said - slope @ (belief.mean - code))
        return belief._replace(mean=code, covariance=belief.covariance - gain @ within @ gain.T)

    def surprise(self, belief: Belief, dv: np.ndarray, forces: np.ndarray) -> float:
        """Chi-square, of as many degrees as pads, of what these tell of a press beside what the network says."""
        count = len(forces)
        found = self._said(self.inputs(dv[None]), belief.mean.astype(np.float32))
        said, slope = (np.asarray(part, float)[:count] for part in found)
        noise, away = self.errors.of(np.maximum(forces, 0))[:count], forces - said
        return float(away @ np.linalg.solve(slope @ belief.covariance @ slope.T + np.diag(noise**2), away))

    def _said(self, x: np.ndarray, code: np.ndarray) -> tuple[jax.Array, jax.Array]:
        parts = jnp.asarray(self.masks, jnp.float32), jnp.asarray(self.centres, jnp.float32)
        return _said_and_slope(self.network, x, code, *parts)


@eqx.filter_jit
def _maps(network: Regressor, x: Any, code: Any) -> jax.Array:
    return network.maps(jnp.asarray(x), jnp.asarray(code))


def _summary(network: Regressor, x: jax.Array, code: jax.Array, masks: jax.Array, centres: jax.Array) -> jax.Array:
    """Forces on the pads, and the centre of the map."""
    force, shares = network(x, code)
    of_pixels = jnp.exp(shares)
    return jnp.concatenate([jnp.exp(force)[..., None] * (of_pixels @ masks.T), of_pixels @ centres], -1)


@eqx.filter_jit
def _said_and_slope(network: Regressor, x: Any, code: Any, *where: jax.Array) -> tuple[jax.Array, jax.Array]:
    say = lambda c: _summary(network, jnp.asarray(x), c, *where)[0]  # noqa: E731
    return say(jnp.asarray(code)), jax.jacfwd(say)(jnp.asarray(code))


def prepared(skin: je.Skin, folder: Path, skins: int, steps: int) -> Adapted:
    """Draw, train, and measure the scatter of the codes and the errors that are left."""
    frames = drawn(skin, folder, skins)
    compression = fit_compression(frames, noise_of(training_bench(skin)))
    examples = examples_of(frames, compression)
    network, codes = train(examples, steps)
    image = je.prepare(je.discretise(je.Scene(skin), je.Fidelity.draft()), basis=PIXELS)
    masks, centres = np.asarray(je.pad_masks(skin, image).weights), np.asarray(image.centres, float)
    scatter = codes.T @ codes / len(codes)
    prior = Belief(np.zeros(MODES), scatter, scatter)
    return Adapted(network, compression, prior, masks, centres, _errors(network, codes, examples, masks, centres))


def _errors(
    network: Regressor, codes: np.ndarray, examples: Examples, masks: np.ndarray, centres: np.ndarray
) -> Errors:
    """What is left on some of the training's skins, from readings alone."""
    where = jnp.asarray(masks, jnp.float32), jnp.asarray(centres, jnp.float32)
    say = eqx.filter_jit(lambda x, code: _summary(network, x, code, *where))
    own, beside, place = [], [], []
    for skin, code in enumerate(codes[:16]):
        part = Examples(*(np.asarray(one[skin]) for one in examples))
        x = inputs(part.seen, part.pads, np.zeros(part.pads.shape, bool))
        said = np.split(np.asarray(say(x, jnp.asarray(code, jnp.float32))), [len(masks)], axis=1)
        total, there = np.exp(part.force)[:, None], part.there > 0
        forces, middle = total * (part.shares @ masks.T), part.shares @ centres
        away, most = np.abs(said[0] - forces), forces > 0.5 * total
        own.append((away / np.maximum(forces, TOUCHED))[most & there[:, None]])
        beside.append((away / total)[~most & there[:, None]])
        place.append(np.abs(said[1] - middle)[there])
    return Errors(*(float(np.percentile(np.concatenate(part), 68)) for part in (own, beside, place)))
