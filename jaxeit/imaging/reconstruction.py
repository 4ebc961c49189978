"""Reconstructors: from a difference of frames to an image of the conductivity change."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import prod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import compiler_options, full_precision, is_traced, require_known, usually, verb
from ..linalg.array_libraries import JAX
from ..model.bases import AbstractPictured, Picture
from ..notebook import card, picture
from .inputs import InverseError, as_flags, require_frames, require_some
from .methods import AbstractIterativeMethod, Problem
from .numpy_images import NumpyImages
from .readings.missing import completed_sums_of_frame, removed, without_readings
from .readings.whitening import Whitening


class Provenance(dict[str, str]):
    """What a reconstructor was made from.

    Compares equal to any other provenance, so that a new date does not trigger recompilation. A reconstructor that a
    compiled function returns therefore has the provenance of that function's first call; attach another one outside.
    """

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Provenance)

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(Provenance)


class AbstractReconstructor(AbstractPictured):
    """Frames to images, without mesh or solver.

    | meaning                                                                        | shape     | unit |
    |--------------------------------------------------------------------------------|-----------|------|
    | whitening: which readings are used, and how much they weigh                    |           |      |
    | predict: pair sums of the one-step image, from the weighted sums ``P^T W dv``  | (k, k)    | ohm2 |
    | picture: where the image lies                                                  |           |      |
    | provenance                                                                     |           |      |
    """

    whitening: eqx.AbstractVar[Whitening]
    predict: eqx.AbstractVar[Float[Array, "k k"]]
    provenance: eqx.AbstractVar[Provenance]

    @abstractmethod
    def _image(self, sums: Float[Array, "... k"]) -> Float[Array, "... basis"]:
        """The image, from the weighted sums ``P^T W dv``."""

    def __call__(self, dv: Float[ArrayLike, "... readings"]) -> Float[Array, "... basis"]:
        """The image, S, of a difference of frames, V; any leading axes are batches.

        Readings that ``channels`` of `prepare` leaves out may hold anything. Any other reading that is not finite is
        replaced by the value that the one-step image of the other readings predicts, at the cost of one small solve:
        the image of `OneStep` is exactly that of a reconstructor which never had the reading, with prior and strength
        unchanged. The replacement loses digits as one over the square of the hyperparameter: three digits are left at
        1e-5, in float32 at 1e-2. Leave out a channel that is dead for good by ``channels`` of `prepare`.

        The first frame with such a reading compiles a program of its own, which takes about a second; `compiled` makes
        one program for all frames at once.

        Raises:
            InverseError: if the last axis does not hold the readings of a frame.
        """
        require_frames(dv, self.readings)
        whole = not is_traced(self, dv) and bool(np.isfinite(np.asarray(dv)).all())
        images: Array = _imaged(self, dv, whole)
        return images

    def compiled(self) -> Callable[[Float[ArrayLike, "... readings"]], Float[Array, "... basis"]]:
        """The reconstructor as a compiled function of the frame, its numbers as constants: less overhead per call."""
        return jax.jit(lambda dv: self(dv), compiler_options=compiler_options())

    def _sums(self, dv: Float[Array, "... readings"]) -> Float[Array, "... k"]:
        sums = self.whitening.sums(dv)
        whole: Array = usually(
            jnp.isfinite(jnp.sum(sums)), _as_they_are, _completed, self.whitening, self.predict, dv, sums
        )
        return whole

    @abstractmethod
    def on_host(
        self, dtype: str | None = None
    ) -> Callable[[Float[np.ndarray, "... readings"]], Float[np.ndarray, "... basis"]]:
        """The reconstructor as a function of NumPy arrays: frames (..., readings) V to images (..., basis) S."""

    def _repr_html_(self) -> str:
        if is_traced(self):
            return card(type(self).__name__, [("state", "traced by JAX: its numbers are hidden")])
        used = int(np.asarray(self.channels).sum())
        rows = [
            (
                "image",
                " x ".join(map(str, self.shape[::-1])) + f", {int((np.asarray(self.areas) > 0).sum())} on the sheet",
            ),
            ("readings", f"{self.readings}" + ("" if used == self.readings else f", of which {used} are used")),
            ("precision", self.dtype),
            *self.provenance.items(),
        ]
        return card(type(self).__name__, rows, self._drawing())

    def _drawing(self) -> str:
        """A picture of the reconstructor for a notebook; none if there is nothing to show."""
        return ""

    @property
    def dtype(self) -> np.dtype:
        """Precision in which images are made."""
        return self.predict.dtype

    @property
    def readings(self) -> int:
        """Number of readings of a frame."""
        return self.whitening.channels.shape[0]

    @property
    def channels(self) -> Bool[Array, " readings"]:
        """Whether each reading is used, (readings,)."""
        return self.whitening.channels


def _as_they_are(
    whitening: Whitening, predict: Float[Array, "k k"], dv: Float[Array, "... readings"], sums: Float[Array, "... k"]
) -> Float[Array, "... k"]:
    return sums


def _completed(
    whitening: Whitening, predict: Float[Array, "k k"], dv: Float[Array, "... readings"], sums: Float[Array, "... k"]
) -> Float[Array, "... k"]:
    """Sums of frames; those that lack readings are completed."""

    def complete(frame: tuple[Float[Array, " readings"], Float[Array, " k"]]) -> Float[Array, " k"]:
        dv, sums = frame
        there = jnp.isfinite(jnp.sum(sums))
        found: Array = jax.lax.cond(there, lambda: sums, lambda: completed_sums_of_frame(whitening, predict, dv))
        return found

    frames = prod(sums.shape[:-1])
    each_frame = dv.reshape(frames, dv.shape[-1]), sums.reshape(frames, sums.shape[-1])
    completed: Array = jax.lax.map(complete, each_frame)
    return completed.reshape(sums.shape)


@partial(jax.jit, static_argnames="whole")
@full_precision
def _imaged(
    recon: AbstractReconstructor, dv: Float[ArrayLike, "... readings"], whole: bool
) -> Float[Array, "... basis"]:
    """The image; without code for missing readings if it is known that all are there."""
    dv = jnp.asarray(dv, recon.predict.dtype)
    return recon._image(recon.whitening.sums(dv) if whole else recon._sums(dv))


@verb
def _matrix(factor: Float[Array, "basis k"], whitening: Whitening, readings: int) -> Float[Array, "basis readings"]:
    return factor @ whitening.sums(jnp.eye(readings, dtype=factor.dtype)).T


class Reconstructor(AbstractReconstructor):
    """A linear reconstruction, ``image = Q dv``, kept as ``Q = factor P^T W`` (see `whitening`).

    | meaning                                                                          | shape      | unit |
    |----------------------------------------------------------------------------------|------------|------|
    | factor: image per weighted sum, entry of ``P^T W dv`` in A/V                     | (basis, k) | S ohm |
    | variance left to each coefficient by readings and prior; infinite where not known | (basis,)  | S^2  |
    | the rest: `AbstractReconstructor`                                                |            |      |

    A call is compiled already. As a step of a compiled function of your own it stands in that function, as below:
    ``jax.jit(recon)`` itself has arrays that JAX cannot hash: write ``jax.jit(lambda dv: recon(dv))`` or
    ``equinox.filter_jit(recon)``.

    Example:
        strongest = jax.jit(lambda dv: jnp.max(recon(dv)))
        print(strongest(dv))  # S
        quick = recon.on_host("float32")  # NumPy to NumPy: for one frame after the other
        images = recon(quiet)  # (frames, pixels) S
        broken = recon.without(jnp.arange(len(v0)) == 7)  # reading 7 has died; nothing else changes
        print(recon.matrix.shape, quick(np.asarray(dv)).dtype)
    """

    factor: Float[Array, "basis k"]
    variance: Float[Array, " basis"]
    predict: Float[Array, "k k"]
    whitening: Whitening
    picture: Picture
    provenance: Provenance = eqx.field(static=True)

    def _image(self, sums: Float[Array, "... k"]) -> Float[Array, "... basis"]:
        return sums @ self.factor.T

    def _drawing(self) -> str:
        if len(self.shape) != 2:
            return ""
        noise = np.linalg.norm(np.asarray(self.matrix, float), axis=1).reshape(self.shape)
        return picture(noise, "Noise of each pixel, if all readings have the same")

    @property
    def matrix(self) -> Float[Array, "basis readings"]:
        """Q as one matrix, (basis, readings) S/V; a reconstructor is applied without it."""
        return _matrix(self.factor, self.whitening, self.readings)

    def on_host(
        self, dtype: str | None = None
    ) -> Callable[[Float[np.ndarray, "... readings"]], Float[np.ndarray, "... basis"]]:
        """The reconstructor in NumPy: for one frame at a time a call of JAX alone takes longer than the image.

        It works in ``dtype``, except that missing readings are replaced in the reconstructor's own precision.

        Raises:
            InverseError: where jit, grad or vmap hides the numbers of the reconstructor; for another precision.
        """
        require_known("on_host", InverseError, self)
        if dtype is not None and dtype not in ("float32", "float64"):
            raise InverseError(f"on_host: dtype is {dtype!r}; give 'float32' or 'float64'")
        return NumpyImages(self.factor, self.predict, self.whitening, dtype or str(self.factor.dtype))

    def astype(self, dtype: str) -> "Reconstructor":
        """The reconstructor in another precision: built in float64, a matrix may be applied in float32.

        Missing readings are then replaced in float32 too, which loses digits (`__call__`); `on_host` keeps the digits.
        """
        other: Reconstructor = jax.tree.map(
            lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, self
        )
        return other

    def without(self, channels: Bool[ArrayLike, " readings"]) -> "Reconstructor":
        """The reconstructor that never had these readings, by an update of its rank; prior and strength stay the same.

        Under jit and vmap the flags may be traced; that no reading is left is then not an error.

        Args:
            channels: flags, true for each reading to leave out.

        Raises:
            InverseError: if the shape does not fit, or no reading would be left.
        """
        used = require_some(self.channels & ~as_flags(channels, self.readings))
        return replace(_without(self, used), provenance=self.provenance)


@verb
def _without(recon: Reconstructor, used: Bool[Array, " readings"]) -> Reconstructor:
    found, gram = without_readings(recon.whitening, used)
    predict, factor = removed(JAX, gram, recon.predict, recon.factor)
    return Reconstructor(
        factor=factor,
        variance=recon.variance + jnp.sum((factor @ gram) * recon.factor, 1),
        predict=predict,
        whitening=found,
        picture=recon.picture,
        provenance=Provenance(),
    )


class IterativeReconstructor(AbstractReconstructor):
    """A reconstruction by a method that solves a problem for each frame.

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

    def on_host(
        self, dtype: str | None = None
    ) -> Callable[[Float[np.ndarray, "... readings"]], Float[np.ndarray, "... basis"]]:
        """See `AbstractReconstructor.on_host`; always in the reconstructor's own precision, whatever ``dtype``."""
        del dtype
        return lambda dv: np.asarray(self(dv))

    def _image(self, sums: Float[Array, "... k"]) -> Float[Array, "... basis"]:
        frames = sums.reshape(prod(sums.shape[:-1]), sums.shape[-1]) @ self.compress.T
        images: Array = jax.lax.map(lambda y: self.method.image(self.problem, y), frames)
        return images.reshape(*sums.shape[:-1], images.shape[-1])
