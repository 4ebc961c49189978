"""How do I get newtons from the pressure of a pad? A curve is fitted, and predicts forces with standard errors."""

import jax
import jax.numpy as jnp

import calib

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

keys = jax.random.split(jax.random.key(0), 2)
pressure = jnp.sort(jax.random.uniform(keys[0], (300,), maxval=6000.0))  # Pa
force = 1.6e-3 * pressure**1.1  # N, of a pad whose area of contact grows
measured = force + 0.2 * jax.random.normal(keys[1], force.shape)

errors = {}
for curve in (calib.Linear(), calib.PowerLaw()):
    fitted = calib.fitting.fit_curve(curve, pressure, measured)
    found = fitted.predict(pressure)
    errors[curve.name] = float(jnp.sqrt(jnp.mean((found.force - force) ** 2)))
    print(f"{curve.name}: error {errors[curve.name]:.3f} N, said to be {found.standard_error.mean():.3f} N")
