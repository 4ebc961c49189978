"""Can a network tell forces from readings alone, once the pads of a skin that it has not seen have taught it?"""

import tempfile
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

import calib
import jaxeit as je

bench, draft, grid = calib.load_bench("paper_bench"), je.Fidelity.draft(dtype="float32"), je.Pixels(20)
names, optimiser = ("frames", "pad_forces", "force_map"), optax.adam(optax.cosine_decay_schedule(1e-3, 3000))
with tempfile.TemporaryDirectory() as folder:
    calib.write_training_frames(calib.bench.FrameSet(bench, 8192, draft, grid), folder, executor=ThreadPoolExecutor(1))
    parts = [calib.open_training_frames(folder).part(*skins) for skins in ((0, 0.875), (0.875, 1))]  # the last skin
    (dv, _, maps), (unseen, pads, truth) = [[jnp.asarray(p[n][p["contacts"] > 0]) for n in names] for p in parts]


def outputs(network, dv):
    size = jnp.linalg.norm(dv, axis=1, keepdims=True)
    features = jax.vmap(network[0])(jnp.concatenate([10 * dv / size, jnp.log(1e3 * size)], 1))
    found = jax.vmap(network[1])(features)
    return features, found[:, 0], jax.nn.log_softmax(found[:, 1:])  # and log force (N), log shares of pixels


@eqx.filter_jit
def step(network, state, dv, maps):
    def loss(network):
        _, force, shares = outputs(network, dv)
        total = maps.sum(1)
        return jnp.mean(jnp.hypot(1.0, 5 * (force - jnp.log(total))) - jnp.sum(maps * shares, 1) / total)

    change, state = optimiser.update(eqx.filter_grad(loss)(network), state)
    return eqx.apply_updates(network, change), state


deep, keys = (551, 64, 256, 2, jnp.tanh, jnp.tanh, True, True, "float32"), jax.random.split(jax.random.key(1), 3)
network = eqx.nn.MLP(*deep, key=keys[0]), eqx.nn.Linear(64, 401, dtype="float32", key=keys[1])
state = optimiser.init(eqx.filter(network, eqx.is_array))
with jax.numpy_dtype_promotion("standard"):  # optax multiplies numbers of several types
    for rows in jax.random.randint(keys[2], (3000, 128), 0, len(dv)):
        network, state = step(network, state, dv[rows], maps[rows])
features, force, shares = outputs(network, unseen)
gain, covariance = jnp.zeros(64, "float32"), 0.3**2 / 32 * jnp.eye(64, dtype="float32")  # of the log force
after, true = {0: force[400:]}, jnp.log(truth[400:].sum(1))
for press in range(400):  # of ordinary use; recursive least squares, as the pads tell the force of each
    along = covariance @ features[press] / (0.15**2 + features[press] @ covariance @ features[press])
    gain += along * (jnp.log(pads[press].sum()) - force[press] - features[press] @ gain)
    covariance -= jnp.outer(along, features[press] @ covariance)
    after[press + 1] = (force + features @ gain)[400:]
errors = {presses: float(jnp.median(jnp.abs(after[presses] - true))) for presses in (0, 30, 120, 400)}
print("error of the force without pads:", ", ".join(f"{e:.1%} after {n} presses" for n, e in errors.items()))
recon = je.prepare(je.discretise(je.Scene(bench.scene.skin), draft), basis=grid, hyperparameter=0.1)
masks = je.pad_masks(bench.scene.skin, recon)
fused = {"image": je.fuse(recon(unseen), masks, pads), "network": je.fuse(jnp.exp(shares), masks, pads)}
wrong = {name: float(jnp.abs(m.force - truth).sum() / truth.sum() / 2) for name, m in fused.items()}
print("force on wrong pixels, fused with the pads:", ", ".join(f"{name} {part:.0%}" for name, part in wrong.items()))
