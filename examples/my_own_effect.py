"""How do I add a physical effect of my own? One class, which scenes in Python and TOML then know."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import jaxeit as je
from jaxeit.effects import AbstractSheetEffect, Sheet

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you


class WetCorner(AbstractSheetEffect):
    """Water in the corner at the origin makes the sheet conduct better there."""

    factor: Float[Array, ""] = je.effects.parameter(2.0)
    radius: Float[Array, ""] = je.effects.parameter(0.05)  # m

    def __call__(self, sheet: Sheet) -> Sheet:
        wet = jnp.linalg.norm(sheet.centroids, axis=1) < self.radius
        return sheet._replace(sigma=jnp.where(wet, self.factor, 1.0) * sheet.sigma)


skin, draft = je.load_skin("testbed"), je.Fidelity.draft()
dry = je.forward(je.discretise(je.Scene(skin), draft))
wet = je.forward(je.discretise(je.Scene(skin, effects=(WetCorner(factor=3.0),)), draft))
print(f"water changes {int((jnp.abs(wet - dry) > 0.01 * jnp.abs(dry)).sum())} of {len(dry)} readings by more than 1 %")
