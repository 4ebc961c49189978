"""What there is: a skin and the effects that act on it."""

import dataclasses
import difflib
from dataclasses import dataclass
from typing import Any

import numpy as np

from .effects import EFFECTS, AbstractEffect, Stream
from .skin import Skin
from .toml import TomlTable


class SceneError(ValueError):
    """A scene whose parts do not fit together."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A skin and a tuple of effects; with none, the ideal sensor.

    What is not listed is neither computed nor compiled.

    Raises:
        SceneError: for anything in ``effects`` that is not an effect, or a bare effect; for two of which a scene can
            have one; for an electrode that the skin has not.
    """

    skin: Skin
    effects: tuple[AbstractEffect, ...] = ()

    def __post_init__(self):
        if not isinstance(self.effects, tuple):
            raise SceneError(f"effects must be a tuple, not {type(self.effects).__name__}")
        for effect in self.effects:
            if not isinstance(effect, AbstractEffect):
                raise SceneError(f"{effect!r} is not an effect; make one, such as jaxeit.LoadSpreading()")
        _check_alternatives(self.effects)
        _check_electrodes(self.effects, len(self.skin.electrodes))


def _check_alternatives(effects: tuple[AbstractEffect, ...]) -> None:
    names: dict[str, str] = {}
    for effect in effects:
        name = type(effect).__name__
        if effect.alternative and effect.alternative in names:
            raise SceneError(f"{names[effect.alternative]} and {name} both say {effect.alternative}; list one of them")
        names[effect.alternative] = name


def _check_electrodes(effects: tuple[AbstractEffect, ...], count: int) -> None:
    for effect in effects:
        for field in dataclasses.fields(effect):
            numbers = np.asarray(getattr(effect, field.name)) if field.name == "electrode" else np.zeros(0)
            if ((numbers < 0) | (numbers >= count)).any():
                raise SceneError(
                    f"{type(effect).__name__}: no electrode {numbers.max()}; the skin has 0 to {count - 1}"
                )


def read_effects(table: TomlTable) -> tuple[AbstractEffect, ...]:
    """The effects of the tables [[effects]] of a scene file: ``type`` and its parameters.

    Raises:
        TomlError: for an effect or a parameter that does not exist, naming the nearest.
    """
    return tuple(_effect(entry) for entry in table.tables("effects"))


def _effect(table: TomlTable) -> AbstractEffect:
    name = table.get("type", lambda v: isinstance(v, str), "the effect's name")
    if name not in EFFECTS:
        near = difflib.get_close_matches(name, EFFECTS, 1)
        hint = f"did you mean {near[0]!r}?" if near else "known: " + ", ".join(EFFECTS)
        raise table.error("type", f"no effect {name!r}; {hint}")
    kind = EFFECTS[name]
    parameters = [f for f in dataclasses.fields(kind) if f.default is not None]
    given = {f.name: _value(table, f) for f in parameters if table.has(f.name)}
    table.done()
    return kind(**given)


def _value(table: TomlTable, field: dataclasses.Field) -> Any:
    """What the file gives for a field, which is of the kind of the field's default."""
    if isinstance(field.default, Stream):
        return Stream(table.choice(field.name, *(s.value for s in Stream)))
    if isinstance(field.default, int):
        return table.get(field.name, lambda v: type(v) is int and 0 <= v < 2**31, "a whole number")
    if isinstance(field.default, tuple):
        return table.array(field.name, None, "[number, ...]")
    return table.number(field.name, "a number", least=float("-inf"))
