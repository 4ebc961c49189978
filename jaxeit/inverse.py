"""Reconstruction: from a difference of frames to an image of the conductivity change."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib import metadata
from typing import TypedDict, Unpack, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .basis import AbstractBasis, AbstractPictured, BasisMap, Picture, Pixels
from .discretise import Model
from .host import HostImages
from .hyperparameter import AbstractHyperparameter, spectrum
from .jacobian import pair_jacobian
from .lapack import solve
from .methods import AbstractIterativeMethod, AbstractLinearMethod, OneStep, Problem, one_step
from .priors import AbstractPrior, Noser
from .verbs import compiler_options
from .whitening import (
    InverseError,
    Whitened,
    Whitening,
    as_flags,
    require_frames,
    require_some,
    whitened_readings,
)

_VERSION = metadata.version("jaxeit")
_MOST = 1e4  # hyperparameter
_FEW = 16  # readings missing from a frame, up to which they are mended one by one


class Provenance(dict[str, str]):
    """What a reconstructor was made from.  All are equal to JAX: another date compiles nothing anew.

    (So what a compiled function returns has the provenance of its first call: attach it outside.)
    """

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Provenance)

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(Provenance)


class AbstractReconstructor(AbstractPictured):
    """Frames to images, without mesh or solver.

    | meaning                                                                        | shape     | unit |
    |--------------------------------------------------------------------------------|-----------|------|
    | whitening: what is used of a frame                                             |           |      |
    | predict: pair sums of the one-step image, from the sums ``P^T W dv``           | (k, k)    | ohm2 |
    | picture: where the image lies                                                  |           |      |
    | provenance                                                                     |           |      |
    """

    whitening: eqx.AbstractVar[Whitening]
    predict: eqx.AbstractVar[Float[Array, "k k"]]
    provenance: eqx.AbstractVar[Provenance]

    @abstractmethod
    def _image(self, sums: Float[Array, "... k"]) -> Float[Array, "... basis"]:
        """The image, from ``P^T W dv``."""

    def __call__(self, dv: Float[ArrayLike, "... readings"]) -> Float[Array, "... basis"]:
        """The image, S, of a difference of frames, V; any leading axes are batches.

        Readings that `prepare` was told to leave out are not looked at, whatever they hold.  Any other that is not
        finite is replaced by what the one-step image of the other readings predicts for it, at the cost of one small
        solve: the image of `OneStep` is exactly that of a reconstructor which never had the reading (prior and
        strength as they were).  That loses digits as one over the square of the hyperparameter, three of which are left
        at 1e-5, in float32 at 1e-2: what is dead for good is better left out by `prepare`.

        Raises:
            InverseError: if the last axis does not hold the readings of a frame.
        """
        require_frames(dv, self.readings)
        return _imaged(self, dv)

    def compiled(self) -> Callable[[Float[ArrayLike, "... readings"]], Float[Array, "... basis"]]:
        """The same as one function of the frame, its numbers built in: a call has a fraction of the overhead."""
        return jax.jit(lambda dv: self(dv), compiler_options=compiler_options())

    def _sums(self, dv: Float[Array, "... readings"]) -> Float[Array, "... k"]:
        sums = self.whitening.sums(dv)

        def each():
            frames = dv.reshape(-1, self.readings)
            return jax.lax.map(self._mended_if_need_be, (frames, sums.reshape(len(frames), -1))).reshape(sums.shape)

        return jax.lax.cond(jnp.isfinite(jnp.sum(sums)), lambda: sums, each)

    def _mended_if_need_be(
        self, of_a_frame: tuple[Float[Array, " readings"], Float[Array, " k"]]
    ) -> Float[Array, " k"]:
        dv, sums = of_a_frame
        return jax.lax.cond(jnp.isfinite(jnp.sum(sums)), lambda: sums, lambda: self._mended(dv))

    def _mended(self, dv: Float[Array, " readings"]) -> Float[Array, " k"]:
        """Sums that give the image of the readings at hand: the others are what that image predicts for them."""
        missing = self.channels & ~jnp.isfinite(dv)
        few = jnp.sum(missing) <= (_FEW if self.whitening.weight.ndim == 1 else 0)
        return jax.lax.cond(few, lambda *a: self._few(*a), lambda *a: self._many(*a), dv, missing)

    def _few(self, dv, missing):
        """Through the missing readings themselves: ``y = P T (t + P^T W y)`` on their rows of P."""
        rows = jnp.flatnonzero(missing, size=_FEW, fill_value=0)
        there = (jnp.arange(_FEW) < jnp.sum(missing)).astype(dv.dtype)
        p = self.whitening.rows(rows) * there[:, None]
        weighted = p * self.whitening.weight[rows, None] if self.whitening.weight.ndim == 1 else p
        sums, through = self.whitening.sums(jnp.where(missing, 0, dv)), p @ self.predict
        y = solve(jnp.eye(_FEW, dtype=dv.dtype) - through @ weighted.T, through @ sums)
        return sums + weighted.T @ y

    def _many(self, dv, missing):
        """Through all pair sums: ``t = sums + G_lost T t``."""
        lost = self.whitening.lost(dv)
        return solve(jnp.eye(len(lost.sums), dtype=dv.dtype) - lost.gram @ self.predict, lost.sums)

    @property
    def readings(self) -> int:
        """Number of readings of a frame."""
        return self.whitening.channels.shape[0]

    @property
    def channels(self) -> Bool[Array, " readings"]:
        """Readings that are used."""
        return self.whitening.channels


@jax.jit
def _imaged(recon: AbstractReconstructor, dv: Float[Array, "... readings"]) -> Float[Array, "... basis"]:
    return recon._image(recon._sums(jnp.asarray(dv, recon.predict.dtype)))


class Reconstructor(AbstractReconstructor):
    """A linear reconstruction, ``image = Q dv``, kept as ``Q = factor P^T W`` (see `whitening`).

    | meaning                                                                          | shape      | unit |
    |----------------------------------------------------------------------------------|------------|------|
    | factor: image per pair sum                                                       | (basis, k) | S V  |
    | variance left to each coefficient by readings and prior; infinite where not known | (basis,)  | S^2  |
    | the rest: `AbstractReconstructor`                                                |            |      |
    """

    factor: Float[Array, "basis k"]
    variance: Float[Array, " basis"]
    predict: Float[Array, "k k"]
    whitening: Whitening
    picture: Picture
    provenance: Provenance = eqx.field(static=True)

    def _image(self, sums):
        return sums @ self.factor.T

    @property
    def matrix(self) -> Float[Array, "basis readings"]:
        """Q as one matrix, S/V; applying a reconstruction does not need it."""
        return self.factor @ self.whitening.sums(jnp.eye(self.readings, dtype=self.factor.dtype)).T

    def on_host(
        self, dtype: str | None = None
    ) -> Callable[[Float[np.ndarray, "... readings"]], Float[np.ndarray, "... basis"]]:
        """The same in NumPy: for one frame at a time a call of JAX alone takes longer than the image.

        In ``dtype``, but for mending, which stays in the reconstructor's own precision.
        """
        return HostImages(self.factor, self.predict, self.whitening, dtype or str(self.factor.dtype))

    def astype(self, dtype: str) -> "Reconstructor":
        """The same in another precision: built in float64, a matrix may be applied in float32.

        What frames lack is then mended in float32 too, which loses digits (`__call__`); not so with `on_host`.
        """
        return jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, self)

    def without(self, channels: Bool[Array, " readings"]) -> "Reconstructor":
        """The reconstruction that never had these readings, (readings,) true to leave out, by an update of its rank.

        Prior and strength stay as they were.

        Raises:
            InverseError: if the shape does not fit, or no reading would be left.
        """
        used = np.asarray(self.channels) & ~as_flags(channels, self.readings)
        return replace(_without(self, jnp.asarray(require_some(used))), provenance=self.provenance)


@eqx.filter_jit
def _without(recon: Reconstructor, used: Bool[Array, " readings"]) -> Reconstructor:
    found, gram = recon.whitening.without(used)
    mend = jnp.eye(len(gram), dtype=gram.dtype) - gram @ recon.predict
    factor, predict = (solve(mend.T, m.T).T for m in (recon.factor, recon.predict))
    return Reconstructor(
        factor=factor,
        variance=recon.variance + jnp.sum((factor @ gram) * recon.factor, 1),
        predict=predict,
        whitening=found,
        picture=recon.picture,
        provenance=Provenance(),
    )


class IterativeReconstructor(AbstractReconstructor):
    """A method that works on each frame anew.

    | meaning                                     | shape  | unit |
    |---------------------------------------------|--------|------|
    | compress: whitened readings, from the sums  | (r, k) | ohm  |
    | problem, method                             |        |      |
    | the rest: `AbstractReconstructor`           |        |      |
    """

    compress: Float[Array, "r k"]
    problem: Problem
    method: AbstractIterativeMethod
    predict: Float[Array, "k k"]
    whitening: Whitening
    picture: Picture
    provenance: Provenance = eqx.field(static=True)

    def _image(self, sums):
        frames = sums.reshape(-1, sums.shape[-1]) @ self.compress.T
        images = jax.lax.map(lambda y: self.method.image(self.problem, y), frames)
        return images.reshape(*sums.shape[:-1], images.shape[-1])


class Settings(TypedDict, total=False):
    """What `prepare` is told by name; see there."""

    noise: Float[ArrayLike, "..."] | None
    hyperparameter: float | AbstractHyperparameter
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


def prepare(
    model: Model,
    prior: AbstractPrior | None = None,
    method: AbstractLinearMethod | AbstractIterativeMethod | None = None,
    basis: AbstractBasis | BasisMap | None = None,
    noise: Float[ArrayLike, "..."] | None = None,
    hyperparameter: float | AbstractHyperparameter = 0.1,
    *,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
    provenance: Mapping[str, str] | None = None,
) -> Reconstructor | IterativeReconstructor:
    """Everything that does not depend on the frame, done once.

    Args:
        prior: default `Noser`.
        method: default `OneStep`.  A linear method gives a `Reconstructor`, another an `IterativeReconstructor`.
        basis: default `Pixels`, 40 along x.
        noise: standard deviation of each reading, (readings,) V, or their covariance, (readings, readings) V^2, as
            measured without contact; default: the same for all, of unknown size.
        hyperparameter: weight of the prior, without unit (see `methods`); 0.1 suits a signal-to-noise ratio of
            60 dB and 0.3 to 1 one of 40 dB.  Or a way to choose it (see `hyperparameter`).
        sigma: conductivity to linearise at, (elements,) S; default: the untouched sheet.
        channels: readings to use; a dead one is left out, never taken for zero.
        provenance: what to write down beside the numbers.

    Returns:
        A reconstructor whose ``provenance["rank"]`` says how many numbers a one-step image follows, ``tr(J Q)``, of
        those that the readings hold.

    Raises:
        InverseError: if a value is out of range or no channel is left, or the result is not finite.
    """
    image = basis if isinstance(basis, BasisMap) else (basis or Pixels()).on(model)
    method, prior = method or OneStep(), prior or Noser()
    found = whitened_readings(model, noise, channels)
    problem = Problem(
        jacobian=pair_jacobian(model, sigma, image, found.electrodes, jnp.asarray(found.factor, model.dtype)),
        readings=jnp.sum(found.whitening.channels).astype(model.dtype),
        hyperparameter=jnp.asarray(jnp.nan, model.dtype),
        prior=prior,
        picture=image.picture,
    )
    chosen = _chosen(hyperparameter, problem, found, noise is not None)
    _check_range(chosen, method, model.dtype)
    problem = replace(problem, hyperparameter=jnp.asarray(chosen, model.dtype))
    linear = method if isinstance(method, AbstractLinearMethod) else OneStep()
    recon, followed = _build(problem, linear, found, noise is not None)
    if not np.isfinite(recon.factor).all():
        raise InverseError(
            "the reconstruction matrix is not finite: the conductivity must be positive, and the noise, in V, within "
            f"the range of {model.dtype}"
        )
    settings = {"method": repr(method), "prior": repr(prior), "hyperparameter": repr(chosen)}
    about = Provenance({"jaxeit": _VERSION, **settings, "rank": _rank(found, followed), **(provenance or {})})
    if isinstance(method, AbstractIterativeMethod):
        eqx.filter_eval_shape(
            method.image, problem, problem.jacobian[:, 0]
        )  # what does not fit is refused here, not at a frame
        return IterativeReconstructor(
            compress=jnp.asarray(found.compress, model.dtype),
            problem=problem,
            method=method,
            predict=recon.predict,
            whitening=recon.whitening,
            picture=recon.picture,
            provenance=about,
        )
    return replace(recon, provenance=about)


@eqx.filter_jit
def _build(
    problem: Problem, method: AbstractLinearMethod, found: Whitened, noise_is_known: bool
) -> tuple[Reconstructor, Float[Array, "r k"]]:
    """The reconstructor, and what a one-step image predicts for the whitened readings, per pair sum."""
    compress = jnp.asarray(found.compress, problem.jacobian.dtype)
    image, followed = one_step(problem, problem.precision(), compress)
    recon = Reconstructor(
        factor=image if isinstance(method, OneStep) else method.image(problem, compress),
        variance=method.variance(problem) if noise_is_known else jnp.full_like(problem.picture.areas, jnp.inf),
        predict=compress.T @ followed,
        whitening=found.whitening,
        picture=problem.picture,
        provenance=Provenance(),
    )
    return recon, followed


def _chosen(hyperparameter, problem: Problem, found: Whitened, noise_is_known: bool) -> float:
    if isinstance(hyperparameter, AbstractHyperparameter):
        if hyperparameter.needs_noise and not noise_is_known:
            raise InverseError(f"{type(hyperparameter).__name__} compares with the noise; give prepare(..., noise=...)")
        return hyperparameter.choose(spectrum(problem), partial(_whiten, found, problem.jacobian.dtype))
    return float(hyperparameter)


def _check_range(hyperparameter: float, method, dtype: np.dtype) -> None:
    """Refuse what leaves no digit: rounding grows by h and 1/h, in methods that work with squares by 1/h^2."""
    eps = float(np.finfo(dtype).eps)
    least = (1e3 * eps) ** 0.5 if isinstance(method, AbstractIterativeMethod) else 8e3 * eps
    if not least <= hyperparameter <= _MOST:
        raise InverseError(
            f"the hyperparameter is {hyperparameter}; give a number above zero, for {type(method).__name__} in {dtype} "
            f"from {least:.1e} to {_MOST:.0e}: below that the image is made of rounding errors, above it of nothing"
        )


def _rank(found: Whitened, followed: Float[Array, "r k"]) -> str:
    """``tr(J Q)``: with E and C of `whitening` it is the trace of ``(J Q E) C^T``."""
    return f"{np.sum(found.factor * np.asarray(followed, float)):.3g} of {len(found.factor)}"


def _whiten(found: Whitened, dtype: np.dtype, dv: Float[ArrayLike, "... readings"]) -> Float[Array, "... r"]:
    return found.whitening.sums(jnp.asarray(dv, dtype)) @ jnp.asarray(found.compress, dtype).T
