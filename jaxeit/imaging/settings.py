"""The choices that make an image, as one object."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..messages.kinds import require_kind
from ..model.bases import BASES, AbstractBasis, Pixels
from ..model.discretisation import Model
from .hyperparameters import HYPERPARAMETERS, AbstractHyperparameter
from .inputs import InverseError
from .methods import METHODS, AbstractIterativeMethod, AbstractLinearMethod, OneStep
from .preparation import Settings, prepare, require_choices
from .priors import PRIORS, AbstractPrior, Noser
from .readings.measured_noise import NOISES, AbstractNoise, EqualNoise
from .reconstruction import IterativeReconstructor, Reconstructor


@dataclass(frozen=True)
class Imaging:
    """How images are made: every choice of `prepare`, without the model and the recording that it is made for.

    | meaning                                                       | default          |
    |---------------------------------------------------------------|------------------|
    | basis: what the coefficients of an image stand for             | `Pixels`         |
    | method: how an image is made from data and prior              | `OneStep`        |
    | prior: what is expected of an image                            | `Noser`          |
    | hyperparameter: weight of the prior, or a way to choose it     | 0.1              |
    | noise: how the readings are weighed                            | `EqualNoise`     |

    Raises:
        InverseError: for a hyperparameter that is not above zero, a choice in the place of another, or choices that do
            not go together: a prior that changes with the image and a method that takes it only once, a method that
            needs a diagonal prior and another one, a hyperparameter that compares with noise and `EqualNoise`.

    Example:
        settings = je.Imaging(je.Pixels(10), prior=je.Tikhonov(), noise=je.imaging.MeasuredNoise())
        same_for_any_skin = settings.prepare(model, quiet=quiet)
    """

    basis: AbstractBasis = field(default_factory=Pixels)
    method: AbstractLinearMethod | AbstractIterativeMethod = field(default_factory=OneStep)
    prior: AbstractPrior = field(default_factory=Noser)
    hyperparameter: float | AbstractHyperparameter = 0.1
    noise: AbstractNoise = field(default_factory=EqualNoise)

    def __post_init__(self) -> None:
        require_kind(
            self.noise, AbstractNoise, InverseError, "a noise", "an object, such as je.imaging.MeasuredNoise()"
        )
        require_choices(self.prior, self.method, self.basis, self.hyperparameter, self.noise.has_size)
        weight = self.hyperparameter
        if isinstance(weight, int | float) and not 0 < weight < float("inf"):
            raise InverseError(f"the hyperparameter is {weight}; give a number above zero, such as 0.1")

    def __str__(self) -> str:
        """The choices by their names, such as "pixels, one-step, noser at 0.1"."""
        weight = self.hyperparameter
        chosen = HYPERPARAMETERS.text(weight) if isinstance(weight, AbstractHyperparameter) else f"{weight:g}"
        noise = "" if isinstance(self.noise, EqualNoise) else f", {NOISES.text(self.noise)} noise"
        return f"{BASES.text(self.basis)}, {METHODS.text(self.method)}, {PRIORS.text(self.prior)} at {chosen}{noise}"

    def prepare(
        self,
        model: Model,
        *,
        quiet: Float[ArrayLike, "frames readings"] | None = None,
        frames: Float[ArrayLike, "... readings"] | None = None,
        channels: Bool[ArrayLike, " readings"] | None = None,
        untouched: Float[ArrayLike, " readings"] | None = None,
        sigma: Float[Array, " elements"] | None = None,
        provenance: Mapping[str, str] | None = None,
    ) -> Reconstructor | IterativeReconstructor:
        """The reconstructor that these choices make of a model, by `prepare`.

        Args:
            quiet: frames without contact less their mean, V, from which the noise is measured; needed unless ``noise``
                is `EqualNoise`.
            frames: differences of readings, at least one of a touch, V; needed by a ``hyperparameter`` that looks at
                frames and has none of its own.
            channels, untouched, sigma, provenance: as for `prepare`.

        Raises:
            InverseError: as for `prepare`, or if the choices need frames that are not given.
            HyperparameterError: if no hyperparameter can be chosen.
        """
        weight = self.hyperparameter
        if isinstance(weight, AbstractHyperparameter) and frames is not None:
            weight = weight.on(frames)
        noise = self.noise.measured(quiet, channels)
        sheet: Settings = {"untouched": untouched, "sigma": sigma, "provenance": provenance}
        settings: Settings = {"noise": noise, "hyperparameter": weight, "channels": channels} | sheet
        return prepare(model, self.prior, self.method, self.basis, **settings)
