"""What an effect is: one family per physical stage, applied in the order of the stages."""

import enum
from abc import abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


class Stream(enum.Enum):
    """The recorded stream that a readout effect disturbs."""

    EIT = "eit"
    PRESSURE = "pressure"
    FORCE = "force"


class Touch(NamedTuple):
    """An indenter on the skin: where (2,) m, and how wide its flat tip is, m."""

    centre: Float[Array, "2"]
    diameter: Float[Array, ""]


class Sheet(NamedTuple):
    """The state of the sheet: conductivity, S; pressure on it, Pa; centres of its elements, m."""

    sigma: Float[Array, " elements"]
    pressure: Float[Array, " elements"]
    centroids: Float[Array, "elements 2"]


def parameter(default: float) -> Any:
    """A numeric field that is a pytree leaf: a new value retraces nothing."""
    return eqx.field(converter=jnp.asarray, default=default)


class AbstractEffect(eqx.Module):
    """One departure from the ideal sensor.  ``rank`` orders effects within their stage."""

    rank: ClassVar[int] = 0

    @abstractmethod
    def __call__(self, state: Any, *context: Any) -> Any:
        """The state of its stage after this effect; each family says what that is."""


class AbstractLoadEffect(AbstractEffect):
    """Mechanics: how a unit load spreads from the indenter to the sheet."""

    @abstractmethod
    def __call__(
        self, spread: Float[Array, " elements"], touch: Touch, centroids: Float[Array, "elements 2"]
    ) -> Float[Array, " elements"]:
        """The pressure per unit load, 1/m^2, from that of the stage before."""


class AbstractSheetEffect(AbstractEffect):
    """Material: how pressure and manufacture change the sheet's conductivity."""

    @abstractmethod
    def __call__(self, sheet: Sheet) -> Sheet:
        """The sheet after this effect."""


class AbstractPadEffect(AbstractEffect):
    """Pneumatics: how strongly a pad feels the pressure at each place of its footprint."""

    @abstractmethod
    def __call__(
        self, response: Float[Array, "pads elements"], distance: Float[Array, "pads elements"]
    ) -> Float[Array, "pads elements"]:
        """The response (1 for an ideal pad) given the distance in m to the pad's outline."""


class AbstractReadoutEffect(AbstractEffect):
    """Readout: how a recorded series departs from the quantity it records."""

    stream: eqx.AbstractVar[Stream]

    @abstractmethod
    def __call__(
        self, series: Float[Array, "time channels"], key: Key[Array, ""], interval: Float[Array, ""]
    ) -> Float[Array, "time channels"]:
        """The series, one row every ``interval`` seconds, after this effect."""


def fold(effects: Iterable[AbstractEffect], family: type, state: Any, *context: Any) -> Any:
    """Apply the effects of one family in order of rank, each under its own name in the program."""
    for effect in sorted((e for e in effects if isinstance(e, family)), key=lambda e: e.rank):
        with jax.named_scope(type(effect).__name__):
            state = effect(state, *context)
    return state
