"""The unknowns of a frame of even content: what is believed of them before, and the readings as a function of them."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.linalg import block_diag

from ...effects import CommonMode, chosen
from ...model.discretisation import Model
from ...model.forward_model import forward
from ...model.motion import Motion, moved
from ...registry import limited, require_limits
from ...registry.limits import LONGEST
from ..inputs import InverseError

MODEL_ERROR = 3e-3
"""Standard error of a reading, relative, where nothing else is said: that of the mesh and the places of electrodes."""


class ReferenceSettings(eqx.Module):
    """Standard deviations before the frame is seen. What has the deviation zero stays as the model has it.

    | meaning                                                                  | default | unit |
    |--------------------------------------------------------------------------|---------|------|
    | level: of the logarithm of the conductivity; 0: the content is known     | 3       | 1    |
    | contact: of the logarithm of what all contact resistances have in common | 3       | 1    |
    | contact_each: of the logarithm of each one's own part; 0: all are alike  | 1       | 1    |
    | gain: of each channel, relative                                          | 0       | 1    |
    | offset: of each channel                                                  | 0       | V    |
    | shift: of each electrode in each direction                               | 0       | m    |
    | common_mode: of the amplifiers' gain for the common-mode voltage         | 0       | 1    |
    | scale: of what all readings have in common: mesh, size, current          | 0.003   | 1    |

    With ``scale`` zero the mesh is taken as exact, in the errors of contacts too.
    """

    level: float = limited(3.0, least=0)
    contact: float = limited(3.0, least=0)
    contact_each: float = limited(1.0, least=0)
    gain: float = limited(0.0, least=0)
    offset: float = limited(0.0, least=0, unit="V")
    shift: float = limited(0.0, least=0, most=LONGEST, unit="m")
    common_mode: float = limited(0.0, least=0)
    scale: float = limited(MODEL_ERROR, least=0)

    def __check_init__(self) -> None:
        require_limits(self, InverseError)
        if not any(value for name, value in vars(self).items() if name != "scale"):
            raise InverseError("all standard deviations are zero; give one above zero to what is unknown")


class ReferenceParameters(NamedTuple):
    """One number for each unknown, whatever it says of them: values, standard deviations or a direction.

    | meaning                                                       | shape           |
    |---------------------------------------------------------------|-----------------|
    | level: of the conductivity                                    | ()              |
    | contact: of the specific contact resistance of each electrode | (electrodes,)   |
    | gain, offset: of each channel                                 | (channels,)     |
    | shift: of each electrode                                      | (electrodes, 2) |
    | common_mode: gain of `je.effects.CommonMode`                  | ()              |
    | scale: of all readings, relative to 1                         | ()              |
    """

    level: Float[Array, ""]
    contact: Float[Array, " electrodes"]
    gain: Float[Array, " channels"]
    offset: Float[Array, " channels"]
    shift: Float[Array, "electrodes 2"]
    common_mode: Float[Array, ""]
    scale: Float[Array, ""]


def prior_root(model: Model, settings: ReferenceSettings, channels: int) -> np.ndarray:
    """The unknowns, (n, k), from k independent ones of unit variance, as they are before the frame is seen."""
    touching = np.asarray(model.contact) > 0
    if not touching.any() and (settings.contact or settings.contact_each):
        raise InverseError(
            "no electrode of the model has a contact resistance to fit, and point electrodes cannot have one; give the "
            "electrodes a contact above zero, or fit none: contact=0 and contact_each=0, or no --fit-contacts"
        )
    if settings.common_mode and not chosen(model.effects, CommonMode):
        raise InverseError("the scene has no CommonMode whose gain could be fitted; add je.effects.CommonMode() to it")
    blocks = [
        np.array([[settings.level]]),
        _alike(touching, settings.contact, settings.contact_each),
        settings.gain * np.eye(channels),
        settings.offset * np.eye(channels),
        settings.shift * np.eye(2 * model.electrodes),
        np.array([[settings.common_mode]]),
        np.array([[settings.scale]]),
    ]
    whole: np.ndarray = block_diag(*blocks)
    return whole[:, whole.any(0)]


def _alike(touching: np.ndarray, together: float, each: float) -> np.ndarray:
    """A root of the covariance ``together^2 1 1^T + each^2 I`` of what touches, of as many columns as it has ranks."""
    ones, count = touching.astype(float)[:, None], max(1, int(touching.sum()))
    if not each:
        return together * ones
    # (each I + m 1 1^T)^2 = each^2 I + (2 each m + count m^2) 1 1^T, solved for m.
    more = (np.hypot(each, np.sqrt(count) * together) - each) / count
    root: np.ndarray = each * np.diag(ones[:, 0]) + more * ones @ ones.T
    return root


def split_unknowns(values: Float[Array, " n"], electrodes: int, channels: int) -> ReferenceParameters:
    """The unknowns, apart."""
    counts = [1, electrodes, channels, channels, 2 * electrodes, 1]
    level, contact, gain, offset, shift, common, scale = jnp.split(values, np.cumsum(counts))
    return ReferenceParameters(level[0], contact, gain, offset, shift.reshape(electrodes, 2), common[0], scale[0])


class ReferenceProblem(eqx.Module):
    """The readings as a function of the unknowns."""

    model: Model
    motion: Motion | None
    channel: Int[Array, " readings"] | None
    channels: int = eqx.field(static=True)
    touches: bool = eqx.field(static=True)  # whether contacts are fitted
    meshed: bool = eqx.field(static=True)  # whether their errors are those of the mesh too
    amplifies: bool = eqx.field(static=True)  # whether the gain for the common mode is
    level: Float[Array, ""]  # conductivity to begin with, over the model's
    spread: Float[Array, "n k"]

    def parts(self, x: Float[Array, " k"]) -> ReferenceParameters:
        """The unknowns, from those of unit variance."""
        return split_unknowns(self.spread @ x, self.model.electrodes, self.channels)

    def there(self, parts: ReferenceParameters) -> Model:
        """The model with these unknowns."""
        model = self.model if self.motion is None else moved(self.model, self.motion, parts.shift)
        background = self.level * jnp.exp(parts.level) * model.background
        contact = self.level * jnp.exp(-parts.contact) * model.contact if self.touches else model.contact
        effects = tuple(
            eqx.tree_at(lambda e: e.gain, effect, effect.gain + parts.common_mode)
            if self.amplifies and isinstance(effect, CommonMode)
            else effect
            for effect in model.effects
        )
        return replace(model, background=background, contact=contact, effects=effects)

    def read(self, x: Float[Array, " k"]) -> Float[Array, " readings"]:
        """The frame, V."""
        parts = self.parts(x)
        readings = (1 + parts.scale) * forward(self.there(parts))
        if self.channel is None:
            return readings
        return (1 + parts.gain[self.channel]) * readings + parts.offset[self.channel]
