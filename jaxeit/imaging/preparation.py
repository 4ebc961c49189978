"""Preparing a reconstructor: everything that does not depend on the frame."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from importlib import metadata
from typing import Any, TypedDict, TypeVar, Unpack, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import full_precision, is_traced, verb
from ..messages.kinds import is_number, require_kind
from ..model.bases import AbstractBasis, BasisMap, Pixels
from ..model.discretisation import Model, require_model
from ..model.sensitivity import pair_jacobian
from .hyperparameters import AbstractHyperparameter, HyperparameterError, spectrum
from .inputs import InverseError
from .methods import AbstractIterativeMethod, AbstractLinearMethod, OneStep, Problem
from .methods.one_step import one_step_image
from .priors import AbstractPrior, Noser
from .readings.whitening import Whitened, Whitening, whitened_readings
from .reconstruction import IterativeReconstructor, Provenance, Reconstructor
from .untouched import background_of

T = TypeVar("T")

_VERSION = metadata.version("jaxeit")
LARGEST_HYPERPARAMETER = 1e4  # above it the prior leaves nothing of the data
_TRACED = "traced by JAX"  # in place of a number that provenance cannot state


class Settings(TypedDict, total=False):
    """Keyword arguments of `prepare`; see there."""

    noise: Float[ArrayLike, "..."] | None
    hyperparameter: Float[ArrayLike, ""] | AbstractHyperparameter
    untouched: Float[ArrayLike, " readings"] | None
    sigma: Float[Array, " elements"] | None
    channels: Bool[ArrayLike, " readings"] | None
    provenance: Mapping[str, str] | None


@overload
def prepare(
    model: Model,
    prior: AbstractPrior | None = None,
    method: AbstractLinearMethod | None = None,
    basis: AbstractBasis | BasisMap | None = None,
    **settings: Unpack[Settings],
) -> Reconstructor: ...


@overload
def prepare(
    model: Model,
    prior: AbstractPrior | None,
    method: AbstractIterativeMethod,
    basis: AbstractBasis | BasisMap | None = None,
    **settings: Unpack[Settings],
) -> IterativeReconstructor: ...


@overload
def prepare(
    model: Model,
    prior: AbstractPrior | None,
    method: AbstractLinearMethod | AbstractIterativeMethod,
    basis: AbstractBasis | BasisMap | None = None,
    **settings: Unpack[Settings],
) -> Reconstructor | IterativeReconstructor: ...


@full_precision
def prepare(
    model: Model,
    prior: AbstractPrior | None = None,
    method: AbstractLinearMethod | AbstractIterativeMethod | None = None,
    basis: AbstractBasis | BasisMap | None = None,
    noise: Float[ArrayLike, "..."] | None = None,
    hyperparameter: Float[ArrayLike, ""] | AbstractHyperparameter = 0.1,
    *,
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
    provenance: Mapping[str, str] | None = None,
) -> Reconstructor | IterativeReconstructor:
    """The reconstructor for a model: everything that does not depend on the frame, done once.

    It works under `jax.jit`, `jax.vmap` and `jax.grad` with respect to ``sigma``, ``noise``, ``hyperparameter``,
    parameters of ``prior`` and ``method``, and parameters of the model that `forward` has derivatives for. Traced
    values are not checked (a value out of range gives an image that is not finite), and the provenance calls them
    traced. The protocol and ``channels`` decide shapes and must be known: use the model from outside the transformed
    function. To pass a large model as an argument, put the known protocol back inside:
    ``eqx.tree_at(lambda m: m.pattern, argument, model.pattern)``, and ``mixing`` where the model has one.

    Args:
        prior: default `Noser`.
        method: default `OneStep`.  A linear method gives a `Reconstructor`, another an `IterativeReconstructor`.
        basis: default `Pixels`, 40 along x.
        noise: standard deviation of each reading, (readings,) V, or their covariance, (readings, readings) V^2, as
            measured without contact; default: the same for all, of unknown size.
        hyperparameter: weight of the prior, without unit (see `methods`); 0.1 suits a signal-to-noise ratio of
            60 dB and 0.3 to 1 one of 40 dB.  Or a way to choose it (see `hyperparameters`).
        untouched: mean frame of the untouched sheet, (readings,) V, to which `fit_background` fits the conductivity to
            linearise at.
        sigma: conductivity to linearise at, (elements,) S, if it is known already; default: that of the model.
        channels: readings to use; a dead one is left out, never taken for zero.
        provenance: what to write down beside the numbers.

    Returns:
        A reconstructor whose ``provenance["rank"]`` says how many numbers a one-step image follows, ``tr(J Q)``, of
        those that the readings hold.

    Raises:
        InverseError: if a value is out of range or no channel is left, or the result is not finite; if both
            ``untouched`` and ``sigma`` are given, or no coating explains the untouched frame; if prior, method or
            basis is an object of another kind, such as a method in the place of the prior; if prior, method,
            hyperparameter and noise do not go together; or if jit, grad or vmap hides the protocol or the channels.
        SceneError: if ``model`` is no model, such as a skin.
        HyperparameterError: if the hyperparameter is to be chosen by values that jit, grad or vmap hides.
    """
    require_model(model)
    method, prior, basis = method or OneStep(), prior or Noser(), basis or Pixels()
    require_choices(prior, method, basis, hyperparameter, noise is not None)
    image = basis if isinstance(basis, BasisMap) else basis.on(model)
    sigma = background_of(model, untouched, sigma, channels)
    found = whitened_readings(model, noise, channels)
    problem = _problem(model, sigma, image, found, prior)
    chosen = _chosen(hyperparameter, problem, found)
    check_range(chosen, method, model.dtype)
    problem = replace(problem, hyperparameter=jnp.asarray(chosen, model.dtype))
    linear = method if isinstance(method, AbstractLinearMethod) else OneStep()
    compress = jnp.asarray(found.compress, model.dtype)
    asked = replace(problem, prior=_traced(prior, model.dtype))
    recon, followed = _build(asked, _traced(linear, model.dtype), compress, found.whitening, noise is not None)
    settings = {"method": _stated(method), "prior": _stated(prior), "hyperparameter": _stated(chosen)}
    about = Provenance({"jaxeit": _VERSION, **settings, "rank": _rank(found, followed), **(provenance or {})})
    # Inside jit, what is known stays known.
    recon = replace(recon, whitening=found.whitening, picture=image.picture, provenance=about)
    _require_finite(recon, prior)
    return recon if isinstance(method, AbstractLinearMethod) else _iterative(method, problem, compress, recon)


def _problem(
    model: Model,
    sigma: Float[Array, " elements"] | None,
    image: BasisMap,
    found: Whitened,
    prior: AbstractPrior,
) -> Problem:
    """The problem of whitened readings, of which the hyperparameter is still open: NaN."""
    return Problem(
        jacobian=pair_jacobian(model, sigma, image, found.electrodes, jnp.asarray(found.factor, model.dtype)),
        readings=jnp.sum(found.whitening.channels).astype(model.dtype),
        hyperparameter=jnp.asarray(jnp.nan, model.dtype),
        prior=prior,
        picture=image.picture,
    )


def _iterative(
    method: AbstractIterativeMethod, problem: Problem, compress: Float[Array, "r k"], linear: Reconstructor
) -> IterativeReconstructor:
    """The reconstructor of a method that solves a problem for each frame; the rest is that of the linear one."""
    eqx.filter_eval_shape(method.image, problem, problem.jacobian[:, 0])  # refuses what does not fit, before any frame
    return IterativeReconstructor(
        compress=compress,
        problem=problem,
        method=method,
        predict=linear.predict,
        whitening=linear.whitening,
        picture=linear.picture,
        provenance=linear.provenance,
    )


def _traced(choice: T, dtype: np.dtype) -> T:
    """One of the package's choices with its numbers as arrays: other numbers then compile nothing anew.

    A choice of a user's own may decide by its numbers in Python, which a traced array does not allow.
    """
    if not type(choice).__module__.startswith(f"{__package__}."):
        return choice
    found: T = jax.tree.map(lambda leaf: np.asarray(leaf, dtype) if isinstance(leaf, float) else leaf, choice)
    return found


@verb
def _build(
    problem: Problem,
    method: AbstractLinearMethod,
    compress: Float[Array, "r k"],
    whitening: Whitening,
    noise_is_known: bool,
) -> tuple[Reconstructor, Float[Array, "r k"]]:
    """The reconstructor, and what a one-step image predicts for the whitened readings, per pair sum."""
    image, followed = one_step_image(problem, problem.precision(), compress)
    recon = Reconstructor(
        factor=image if isinstance(method, OneStep) else method.image(problem, compress),
        variance=method.variance(problem) if noise_is_known else jnp.full_like(problem.picture.areas, jnp.inf),
        predict=compress.T @ followed,
        whitening=whitening,
        picture=problem.picture,
        provenance=Provenance(),
    )
    return recon, followed


def _chosen(hyperparameter: Any, problem: Problem, found: Whitened) -> Any:
    """The hyperparameter as a number, or as an array where JAX traces it."""
    if not isinstance(hyperparameter, AbstractHyperparameter):
        return hyperparameter if is_traced(hyperparameter) else float(hyperparameter)
    name = type(hyperparameter).__name__
    if is_traced(hyperparameter, problem):
        raise HyperparameterError(
            f"{name} chooses by looking at values, which jit, grad or vmap hides; choose once outside the transformed "
            "function and give the number"
        )
    return hyperparameter.choose(spectrum(problem), partial(_whiten, found, problem.jacobian.dtype))


def require_choices(prior: Any, method: Any, basis: Any, weight: Any, noise_is_known: bool) -> None:
    """Refuse a choice that stands in the place of another, and choices that do not go together."""
    for name, choice, kinds, example in (
        ("prior", prior, AbstractPrior, "prior=Noser()"),
        ("method", method, (AbstractLinearMethod, AbstractIterativeMethod), "method=OneStep()"),
        ("basis", basis, (AbstractBasis, BasisMap), "basis=Pixels(40)"),
    ):
        require_kind(choice, kinds, InverseError, f"a {name}", f"an object, such as {example}")
    if prior.follows_image and not method.follows_prior:
        raise InverseError(
            f"the prior {type(prior).__name__} changes with the image, and the method {type(method).__name__} takes it "
            "only once; choose the method Reweighted, or another prior"
        )
    if method.needs_diagonal_prior and prior.diagonal is False:
        raise InverseError(
            f"the method {type(method).__name__} needs a diagonal prior, which {type(prior).__name__} is not; choose "
            "the prior Noser or Tikhonov, or another method"
        )
    if isinstance(weight, AbstractHyperparameter) and weight.needs_noise and not noise_is_known:
        raise InverseError(
            f"the hyperparameter {type(weight).__name__} compares with the noise, whose size is not known; give the "
            "noise in V, prepare(..., noise=...), or choose noise that is measured, as Imaging(noise=MeasuredNoise()) "
            "or --noise measured"
        )
    if not (isinstance(weight, AbstractHyperparameter) or is_traced(weight) or is_number(weight)):
        ways = "a number, such as 0.1, or a way to choose one, such as je.imaging.LCurve(dv)"
        raise InverseError(f"the hyperparameter is {weight!r}; give {ways}")


def check_range(hyperparameter: Any, method: Any, dtype: np.dtype) -> None:
    """Refuse what leaves no digit: rounding grows by h and 1/h, in methods that work with squares by 1/h^2."""
    eps = float(np.finfo(dtype).eps)
    least = (1e3 * eps) ** 0.5 if isinstance(method, AbstractIterativeMethod) else 8e3 * eps
    if not is_traced(hyperparameter) and not least <= hyperparameter <= LARGEST_HYPERPARAMETER:
        raise InverseError(
            f"the hyperparameter is {hyperparameter}; give a number above zero, for {type(method).__name__} in {dtype} "
            f"from {least:.1e} to {LARGEST_HYPERPARAMETER:.0e}: below that the image is made of rounding errors, above "
            "it of nothing"
        )


def _require_finite(recon: Reconstructor, prior: AbstractPrior) -> None:
    if not is_traced(recon.factor) and not np.isfinite(recon.factor).all():
        raise InverseError(
            f"the reconstruction matrix is not finite: the conductivity and the precision of the prior "
            f"{type(prior).__name__} must be positive, and the noise, in V, within the range of {recon.factor.dtype}"
        )


def _stated(choice: Any) -> str:
    """A choice in words, for the provenance."""
    if not is_traced(choice):
        return repr(choice)
    return f"{type(choice).__name__}, {_TRACED}" if isinstance(choice, eqx.Module) else _TRACED


def _rank(found: Whitened, followed: Float[Array, "r k"]) -> str:
    """``tr(J Q)``: with E and C of `whitening` it is the trace of ``(J Q E) C^T``."""
    if is_traced(found.factor, followed):
        return _TRACED
    return f"{np.sum(found.factor * np.asarray(followed, float)):.3g} of {len(found.factor)}"


def _whiten(found: Whitened, dtype: np.dtype, dv: Float[ArrayLike, "... readings"]) -> Float[Array, "... r"]:
    return found.whitening.sums(jnp.asarray(dv, dtype)) @ jnp.asarray(found.compress, dtype).T
