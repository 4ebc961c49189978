"""What there is: a skin and the effects that act on it."""

import dataclasses
import difflib
from dataclasses import dataclass
from typing import Any

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
        SceneError: for anything in ``effects`` that is not an effect, or a bare effect.
    """

    skin: Skin
    effects: tuple[AbstractEffect, ...] = ()

    def __post_init__(self):
        if not isinstance(self.effects, tuple):
            raise SceneError(f"effects must be a tuple, not {type(self.effects).__name__}")
        for effect in self.effects:
            if not isinstance(effect, AbstractEffect):
                raise SceneError(f"{effect!r} is not an effect; make one, such as jaxeit.LoadSpreading()")


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
    given = {f.name: _value(table, f.name) for f in dataclasses.fields(kind) if table.has(f.name)}
    table.done()
    return kind(**given)


def _value(table: TomlTable, key: str) -> Any:
    if key == "stream":
        return Stream(table.choice(key, *(s.value for s in Stream)))
    if key == "seed":
        return table.get(key, lambda v: type(v) is int and 0 <= v < 2**31, "a whole number")
    return table.number(key, "a number", least=float("-inf"))
