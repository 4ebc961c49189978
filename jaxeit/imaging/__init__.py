"""Images of the conductivity change: noise, priors, methods, hyperparameters, and the reconstructors made of them.

Example:
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
    v0 = je.forward(model)
    near = jnp.linalg.norm(model.centroids - jnp.array([0.06, 0.13]), axis=1) < 0.01
    dv = je.forward(model, model.background * jnp.where(near, 1.5, 1.0)) - v0  # V
    noise = jnp.full(len(v0), 1e-4 * jnp.abs(v0).max())  # V, of each reading
    dv = dv + noise * jax.random.normal(jax.random.key(0), dv.shape)
    # V, frames without contact
    quiet = v0 + noise * jax.random.normal(jax.random.key(1), (50, len(v0)))

    recon = je.prepare(model, je.Laplace(), je.OneStep(), je.Pixels(20), noise, hyperparameter=0.3)
    image = recon(dv)  # S; frames along leading axes are imaged together
    spread = jnp.sqrt(recon.variance)  # S, what readings and prior leave open
    print(recon.provenance["rank"], "numbers of the readings show in an image")
    print(f"the touch is {(image / spread).max():.0f} standard deviations above zero")
    je.save_reconstructor(recon, "recon.npz")
    again = je.load_reconstructor("recon.npz")  # numbers alone: no mesh, no solver

Example: priors and methods compared
    ways = (
        (je.Noser(), je.OneStep()),
        (je.Tikhonov(), je.TruncatedSvd()),
        (je.Noser(), je.NonNegative()),
        (je.Noser(), je.SparseBayes()),
        (je.Noser(), je.imaging.BackProjection()),
    )
    coarse = je.Pixels(10).on(model)
    for prior, method in ways:
        found = je.prepare(model, prior, method, coarse)
        error = je.localisation_error(je.LevelCentroid(0.5)(found(dv), found), jnp.array([0.06, 0.13]))
        print(f"{je.imaging.METHODS.text(method)}, {type(prior).__name__}: {1e3 * error:.1f} mm")
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
