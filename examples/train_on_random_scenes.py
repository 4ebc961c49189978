"""Can a network learn where the force is from simulated skins? Trained on some, tested on one that it has not seen."""

import tempfile
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp

import calib
import jaxeit as je

bench, draft = calib.load_bench("paper_bench"), je.Fidelity.draft(dtype="float32")
with tempfile.TemporaryDirectory() as folder:
    # On the command line: jaxeit simulate paper_bench --random-scenes 5120 -o FOLDER --fidelity draft --pixels 20
    frame_set = calib.bench.FrameSet(bench, 5 * 1024, fidelity=draft, pixels=je.Pixels(20))
    calib.write_training_frames(frame_set, folder, executor=ThreadPoolExecutor(1))
    frames = calib.open_training_frames(folder)  # each 1,024 frames are another skin
    known, unseen = (
        {name: part[name][part["contacts"] > 0] for name in ("frames", "pad_forces", "force_map", "contacts")}
        for part in (frames.part(0, 0.8), frames.part(0.8, 1))
    )


def inputs(frames):
    return frames / jnp.linalg.norm(frames, axis=1, keepdims=True)


def shares(maps):
    return maps / (1e-9 + maps.sum(1, keepdims=True))


@eqx.filter_jit
def train(network, x, y, key, rate, steps=1000, batch=64, momentum=0.9):
    """Stochastic gradient descent with momentum, on the cross-entropy of each pixel's share of the force."""
    weights, rest = eqx.partition(network, eqx.is_array)

    def loss(weights, rows):
        found = jax.nn.log_softmax(jax.vmap(eqx.combine(weights, rest))(x[rows]))
        return -jnp.mean(jnp.sum(y[rows] * found, 1))

    def step(state, key):
        slope = jax.grad(loss)(state[0], jax.random.randint(key, (batch,), 0, len(x)))
        speed = jax.tree.map(lambda v, g: momentum * v - rate * g, state[1], slope)
        return (jax.tree.map(jnp.add, state[0], speed), speed), None

    still = jax.tree.map(jnp.zeros_like, weights)
    (weights, _), _ = jax.lax.scan(step, (weights, still), jax.random.split(key, steps))
    return eqx.combine(weights, rest)


x, y, truth = inputs(known["frames"]), shares(known["force_map"]), shares(unseen["force_map"])
network = eqx.nn.MLP(x.shape[1], y.shape[1], width_size=128, depth=2, key=jax.random.key(0), dtype="float32")
for rate in (0.3, 0.1, 0.03):
    network = train(network, x, y, jax.random.key(1), jnp.float32(rate))
learned = jax.nn.softmax(jax.vmap(network)(inputs(unseen["frames"])))
recon = je.prepare(je.discretise(je.Scene(bench.scene.skin), draft), basis=je.Pixels(20), hyperparameter=0.1)
fused = shares(je.fuse(recon(unseen["frames"]), je.pad_masks(bench.scene.skin, recon), unseen["pad_forces"]).force)
errors = {n: float(jnp.abs(m - truth).sum(1).mean() / 2) for n, m in (("network", learned), ("fused image", fused))}
print("force on the wrong pixels:", ", ".join(f"{name} {error:.0%}" for name, error in errors.items()))
