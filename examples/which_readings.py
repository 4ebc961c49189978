"""Which readings of a scan are worth taking? They are chosen one by one, by what each tells beside the others."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

skin = je.load_skin("testbed")
model = je.discretise(je.Scene(skin), je.Fidelity.draft())
noise = jnp.full(skin.protocol.readings, 1e-6)  # V
signal = je.scan.signal_covariance(model, basis=je.Pixels(20), noise=noise)

chosen = je.scan.choose_readings(signal, 80)


def information(rows):
    """What a set of readings tells about the image: log det(1 + K)."""
    return jnp.linalg.slogdet(jnp.eye(len(rows)) + signal[rows][:, rows])[1]


every = information(jnp.arange(len(signal)))
lots = jax.random.choice(jax.random.key(0), len(signal), (80,), replace=False)
shares = {"chosen": chosen.gain.sum() / every, "at random": information(lots) / every}
for name, share in shares.items():
    print(f"80 of {len(signal)} readings, {name}: {100 * share:.0f} % of the information of all")
rates = [1 / je.scan.scan_time(p) for p in (skin.protocol, je.scan.shortened(skin.protocol, chosen.rows))]
print(f"frames per second: {rates[0]:.0f} with all, {rates[1]:.0f} with 80")
