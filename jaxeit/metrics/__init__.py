"""Figures of merit: the position of a contact in an image, the fidelity of the image, the evenness of sensitivity.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
    recon = je.prepare(model, basis=je.Pixels(20))
    places = jnp.array([[0.06, 0.13], [0.1, 0.1], [0.15, 0.05]])  # m
    bumps = jnp.exp(-jnp.sum((model.centroids - places[:, None]) ** 2, -1) / (2 * 0.008**2))
    touched = jax.vmap(lambda bump: je.forward(model, model.background * (1 + 0.5 * bump)))(bumps)
    images = recon(touched - je.forward(model))  # S, one for each place
    image = images[0]

    for name in ("peak", "half", "quarter", "positive", "level-centroid:level=0.4"):
        estimator = je.metrics.ESTIMATORS.make(name)  # "half" is LevelCentroid(0.5)
        errors = je.localisation_error(estimator(images, recon), places)
        print(f"{name}: {1e3 * errors.mean():.1f} mm")
    figures = je.metrics.greit_figures(images, recon, places, [0.1, 0.1])
    print(figures.resolution, figures.ringing)  # 1
"""

from .estimators import ESTIMATORS, AbstractEstimator, LevelCentroid, Peak, PositiveCentroid
from .evenness import coefficient_of_variation, image_sum
from .greit import GreitFigures, greit_figures
from .inputs import MetricError, Pictured
from .otsu import otsu_thresholds
from .place_errors import inward_bias, localisation_error
from .similarity import image_correlation, ktc_score, structural_similarity

__all__ = [
    "ESTIMATORS",
    "AbstractEstimator",
    "GreitFigures",
    "LevelCentroid",
    "MetricError",
    "Peak",
    "Pictured",
    "PositiveCentroid",
    "coefficient_of_variation",
    "greit_figures",
    "image_correlation",
    "image_sum",
    "inward_bias",
    "ktc_score",
    "localisation_error",
    "otsu_thresholds",
    "structural_similarity",
]
