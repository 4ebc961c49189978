"""The families of effects: one per physical stage, applied in the order of the stages.

| stage      | family                    | acts on                                                           |
|------------|---------------------------|-------------------------------------------------------------------|
| mechanics  | `AbstractStageEffect`     | places and times at which the stage presses                       |
| mechanics  | `AbstractLoadEffect`      | pressure on the sheet under a unit load                           |
| material   | `AbstractMemoryEffect`    | the load on the sheet, a history                                  |
| material   | `AbstractSheetEffect`     | conductivity of the sheet, from pressure and manufacture          |
| material   | `AbstractCoatEffect`      | the same, with a second sheet that `discretise` adds to the model |
| electrical | `AbstractContactEffect`   | contact conductance of the electrodes                             |
| electrical | `AbstractTerminalEffect`  | voltages between terminals, from the transfer matrix              |
| pneumatics | `AbstractPadEffect`       | response of a pad to pressure at each place                       |
| pneumatics | `AbstractPneumaticEffect` | the pressures in the pads, a history                              |
| readout    | `AbstractScanEffect`      | time of each reading in a scan                                    |
| readout    | `AbstractReadoutEffect`   | a recorded stream, a history                                      |
| readout    | `AbstractClockEffect`     | the time stamps of a stream, and lost samples                     |

Histories are processed in blocks of samples; a history effect passes its state from one block to the next.
"""

import zlib
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .._compile import is_traced
from ..registry import limited, require_limits
from ..registry.limits import LONGEST
from .quantities import Circuit, HistoryInputs, Indenter, Packets, Path, Series, Sheet, State, StreamKind

MOST_STD = 3.0
"""Largest standard deviation of a logarithm: 95 % of what is drawn lie within a factor of 400."""


def parameter(default: float | tuple[float, ...], *, least: float = 0.0, finite: bool = True, **limits: Any) -> Any:
    """A numeric field that is a pytree leaf, so that a new value does not trigger recompilation.

    An effect with a value outside of its ``limits`` (`jaxeit.registry.limited`) is refused when it is made, unless jit,
    grad or vmap hides the value. They are where the law itself ends, far beyond the values of real skins.
    """
    return limited(default, least=least, finite=finite, converter=jnp.asarray, **limits)


def metres(default: float, **limits: Any) -> Any:
    """A `parameter` that is a length, m, of which one above `LONGEST` is refused as well."""
    return limited(default, **{"least": 0.0} | limits, most=LONGEST, unit="m", converter=jnp.asarray)


class EffectError(ValueError):
    """An effect whose parameters have no meaning; the message names the parameter."""


def require_relation(effect: "AbstractEffect", names: Sequence[str], holds: Callable[..., bool], wanted: str) -> None:
    """Refuse an effect whose parameters do not fit one another, unless jit, grad or vmap hides one of them.

    Args:
        holds: whether the values of the parameters, as NumPy's arrays, fit.
        wanted: what to give instead, for the message.
    """
    require_limits(effect, EffectError)  # of the classes above comes later
    values = [getattr(effect, name) for name in names]
    if not any(map(is_traced, values)) and not holds(*map(np.asarray, values)):
        given = " and ".join(
            f"{name} is {np.asarray(value).tolist()}" for name, value in zip(names, values, strict=True)
        )
        raise EffectError(f"{type(effect).__name__}: {given}; give {wanted}")


class AbstractEffect(eqx.Module):
    """One departure from the ideal sensor.

    ``rank`` orders effects within their family.  A scene lists at most one effect of each ``alternative``.  An effect
    ``of_pairs`` acts on the pair that drives and the pair that senses, which readings of a protocol of matrices lack.
    A scene file must give the parameters ``to_be_set``, whose defaults of 1 are no usual value.

    Raises:
        EffectError: for a parameter outside of its limits, such as a negative standard deviation, and for parameters
            that do not fit one another.
    """

    stage: ClassVar[str]
    rank: ClassVar[int] = 0
    alternative: ClassVar[str] = ""
    of_pairs: ClassVar[bool] = False
    to_be_set: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self) -> None:
        require_limits(self, EffectError)

    @abstractmethod
    def __call__(self, state: Any, /, *context: Any) -> Any:
        """The quantity that the family acts on, after this effect."""


class AbstractStageEffect(AbstractEffect):
    """Mechanics: places and times at which the stage presses."""

    stage: ClassVar[str] = "mechanics"

    @abstractmethod
    def __call__(self, path: Path, key: Key[Array, ""]) -> Path:
        """The motion of the stage when its command is ``path``."""


class AbstractLoadEffect(AbstractEffect):
    """Mechanics: spread of a unit load from the indenter to the sheet."""

    stage: ClassVar[str] = "mechanics"

    @abstractmethod
    def __call__(
        self, spread: Float[Array, " elements"], touch: Indenter, centroids: Float[Array, "elements 2"]
    ) -> Float[Array, " elements"]:
        """The pressure per unit load (elements,) 1/m^2 after this effect, from that before it.

        Args:
            centroids: of the elements, (elements, 2) m.
        """


class AbstractHistoryEffect(AbstractEffect):
    """An effect on a series of samples, which it processes block by block."""

    def start(self, first: Float[Array, " channels"]) -> State:
        """The state before the first sample, from the series' value at rest, (channels,); by default empty."""
        return ()

    @abstractmethod
    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        """The block (time, channels) after this effect, from that before it, and the state for the next block."""


class AbstractMemoryEffect(AbstractHistoryEffect):
    """Material: the load of each contact on the sheet, N; each contact is a channel."""

    stage: ClassVar[str] = "material"


class AbstractSheetEffect(AbstractEffect):
    """Material: the change of the sheet's conductivity by pressure and manufacture."""

    stage: ClassVar[str] = "material"

    @abstractmethod
    def __call__(self, sheet: Sheet) -> Sheet:
        """The sheet after this effect."""

    def laid(self, centroids: Float[Array, "elements 2"]) -> "AbstractSheetEffect":
        """This effect for elements at these places, (elements, 2) m, with all values that depend on places alone
        computed in advance; by default the effect itself."""
        return self


class AbstractCoatEffect(AbstractSheetEffect):
    """Material: a second conducting sheet, which touches the first under pressure."""


class AbstractContactEffect(AbstractEffect):
    """Electrical: the contact conductance of the electrodes, S/m^2 (area electrodes) or S/m (electrodes on the rim)."""

    stage: ClassVar[str] = "electrical"

    @abstractmethod
    def __call__(self, contact: Float[Array, " electrodes"]) -> Float[Array, " electrodes"]:
        """The conductances (electrodes,) after this effect; 0 stands for a perfect contact and remains 0."""


class AbstractTerminalEffect(AbstractEffect):
    """Electrical: changes of the terminal voltages by source and amplifier."""

    stage: ClassVar[str] = "electrical"
    of_pairs: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, voltage: Float[Array, " readings"], circuit: Circuit) -> Float[Array, " readings"]:
        """The voltages of a frame, (readings,) V, after this effect, from those before it."""


class AbstractPadEffect(AbstractEffect):
    """Pneumatics: the response of a pad to pressure at each place of its footprint."""

    stage: ClassVar[str] = "pneumatics"

    @abstractmethod
    def __call__(
        self, response: Float[Array, "pads elements"], distance: Float[Array, "pads elements"]
    ) -> Float[Array, "pads elements"]:
        """The response (1 for an ideal pad) given the distance in m to the pad's outline."""


class AbstractPneumaticEffect(AbstractHistoryEffect):
    """Pneumatics: the gage pressures in the pads, Pa; each pad is a channel."""

    stage: ClassVar[str] = "pneumatics"


class AbstractScanEffect(AbstractEffect):
    """Readout: the time of each reading of a frame, s after the frame's time."""

    stage: ClassVar[str] = "readout"

    @abstractmethod
    def __call__(
        self, when: Float[Array, " readings"], nominal: Float[Array, " readings"]
    ) -> Float[Array, " readings"]:
        """The times (readings,) s after this effect; ``nominal`` are those of the skin's protocol."""


class AbstractReadoutEffect(AbstractHistoryEffect):
    """Readout: the deviation of a recorded series from the quantity it records.

    ``stream`` is the recorded stream that the effect acts on.
    """

    stage: ClassVar[str] = "readout"
    stream: eqx.AbstractVar[StreamKind]


class AbstractClockEffect(AbstractEffect):
    """Readout: errors of clocks and links on the samples of a stream."""

    stage: ClassVar[str] = "readout"
    stream: eqx.AbstractVar[StreamKind]

    @abstractmethod
    def __call__(self, packets: Packets, key: Key[Array, ""]) -> Packets:
        """The packets after this effect."""


def laid(effects: Iterable[AbstractEffect], centroids: Float[Array, "elements 2"]) -> tuple[AbstractEffect, ...]:
    """The effects, with sheet effects prepared by `AbstractSheetEffect.laid`, for many states of one mesh.

    Example:
        # Random fields are computed once, for many states of one mesh.
        once = effects.laid(scene.effects, model.centroids)
    """
    return tuple(e.laid(centroids) if isinstance(e, AbstractSheetEffect) else e for e in effects)


def chosen(effects: Iterable[AbstractEffect], family: type, stream: StreamKind | None = None) -> tuple[Any, ...]:
    """The effects of one family (and one stream, if given) in the order in which they act.

    Example:
        print(effects.chosen(scene.effects, effects.AbstractSheetEffect))  # in the order in which they act
    """
    mine = (e for e in effects if isinstance(e, family) and (stream is None or getattr(e, "stream", None) is stream))
    return tuple(sorted(mine, key=lambda e: e.rank))


def fold(effects: Iterable[AbstractEffect], family: type, state: Any, *context: Any) -> Any:
    """Apply the effects of one family in order of rank, each in a scope with its name in the compiled program.

    Example:
        when = jnp.asarray(skin.protocol.reading_offsets)  # s
        late = effects.fold(
            (effects.ScanSkew(stretch=1.2),), effects.AbstractScanEffect, jnp.zeros_like(when), when
        )
        sent = effects.Packets(when, when, jnp.zeros(len(when), bool))
        links = (effects.ClockError(skew=5e-5), effects.DropOut(probability=0.01))
        for link, key in zip(links, effects.keys(links, jax.random.key(1)), strict=True):
            sent = link(sent, key)
        plan = effects.Path(jnp.full((9, 2), 0.1), jnp.zeros(9), jnp.ones(9))  # m, s, 1, of nine presses
        pressed = effects.StageError(position=2e-5)(plan, jax.random.key(2))
        print(late[-1], sent.lost.sum(), pressed.places[0])  # s, samples, m
    """
    for effect in chosen(effects, family):
        with jax.named_scope(type(effect).__name__):
            before, state = state, effect(state, *context)
            _require_same_kind(type(effect).__name__, before, state)
    return state


def _require_same_kind(name: str, before: Any, after: Any) -> None:
    """Refuse what an effect returns in the place of its argument: another type, other shapes, or fewer digits."""
    if isinstance(before, tuple):
        kind = type(before).__name__
        if not isinstance(after, type(before)):
            given = "an array" if hasattr(after, "shape") else type(after).__name__
            raise EffectError(f"{name} returns {given}; return the {kind} that it is given, changed by _replace")
        fields = getattr(before, "_fields", range(len(before)))
        pairs = [(f"{kind}.{field}", *both) for field, *both in zip(fields, before, after, strict=True)]
    else:
        pairs = [("an array", before, after)]
    for what, old, new in pairs:
        if not hasattr(old, "shape"):
            continue
        if getattr(new, "shape", None) != old.shape:
            raise EffectError(f"{name} returns {what} of shape {getattr(new, 'shape', new)}; it must stay {old.shape}")
        if _digits(new) < _digits(old):
            raise EffectError(f"{name} returns {what} in {new.dtype}; it must stay {old.dtype}, as by .astype")


def _digits(array: Any) -> float:
    """Bits of an array of floating-point numbers; infinite for others, such as counts and keys."""
    return jnp.finfo(array.dtype).bits if jnp.issubdtype(array.dtype, jnp.floating) else np.inf


def keys(effects: Iterable[AbstractEffect], key: Key[Array, ""]) -> list[Key[Array, ""]]:
    """A key for each effect, derived from its name and from the number of effects of that name before it.

    The key of one effect does not change when others are added or removed.
    """
    out, seen = [], dict[str, int]()
    for effect in effects:
        name = type(effect).__name__
        seen[name] = seen.get(name, -1) + 1
        out.append(jax.random.fold_in(jax.random.fold_in(key, zlib.crc32(name.encode())), seen[name]))
    return out


def history_start(effects: Iterable[AbstractHistoryEffect], first: Float[Array, " channels"]) -> tuple[State, ...]:
    """States of these history effects before the first sample, from the series' value at rest, (channels,)."""
    return tuple(effect.start(first) for effect in effects)


def history(
    effects: Iterable[AbstractHistoryEffect], series: Series, states: tuple[State, ...], inputs: HistoryInputs
) -> tuple[Series, tuple[State, ...]]:
    """A block (time, channels) of a series after these effects, in the order given; their states for the next block."""
    after = []
    effects = tuple(effects)
    for effect, state, key in zip(effects, states, keys(effects, inputs.key), strict=True):
        with jax.named_scope(type(effect).__name__):
            series, state = effect(series, state, inputs._replace(key=key))
        after.append(state)
    return series, tuple(after)
