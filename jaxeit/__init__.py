"""jaxeit: from what an EIT-pneumatic robot skin records to force maps in newtons.

Nouns are frozen pytrees, verbs are pure jitted functions, choices are objects, and physics that is
not in the scene is not in the program.

The names used every day are here; each room holds the rest, such as `jaxeit.effects.Creep` or
`jaxeit.metrics.greit_figures`.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you
    je.limit_blas_threads()  # both once, before the first computation
    je.reuse_memory()

    skin = je.load_skin("testbed")
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    pressed = jnp.linalg.norm(model.centroids - jnp.array([0.06, 0.13]), axis=1) < 0.01
    dv = je.forward(model, model.background * jnp.where(pressed, 1.5, 1.0)) - je.forward(model)  # V

    recon = je.prepare(model, basis=je.Pixels(20))
    # N on each pad
    fmap = je.fuse(recon(dv), je.pad_masks(skin, recon), jnp.array([0.0, 0.0, 12.0, 0.0]))
    print(f"{fmap.force.sum():.1f} N in all, at most {fmap.pressure.max() / 1e3:.0f} kPa")
"""

from importlib import import_module, metadata
from typing import Any

import lazy_loader

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _attribute(name)
    except AttributeError:
        if name.startswith("_"):
            raise
        hints = import_module(".messages.missing_names", __name__)  # on an error only
        raise AttributeError(hints.message(__file__, name, __all__), name=name) from None


__version__ = metadata.version("jaxeit")
