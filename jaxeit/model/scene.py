"""A scene: a skin and the effects that act on it."""

import dataclasses
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path

from ..effects import EFFECTS, AbstractEffect
from ..messages.kinds import stated
from ..skin.description import Skin
from ..toml import TomlTable


class SceneError(ValueError):
    """A scene whose parts do not fit together."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A skin and a tuple of effects; with none, the ideal sensor.

    Effects that are not listed are neither computed nor compiled.

    Raises:
        SceneError: if ``skin`` is not a `Skin`; if ``effects`` is not a tuple of effects; if two of them are
            alternatives; if one holds anything but numbers in a field that is not static; if one names an electrode
            that the skin does not have.
    """

    skin: Skin
    effects: tuple[AbstractEffect, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.skin, Skin):
            raise SceneError(f'{self.skin!r} is not a skin; make one, such as jaxeit.load_skin("testbed")')
        if not isinstance(self.effects, tuple):
            raise SceneError(f"effects must be a tuple, not {type(self.effects).__name__}")
        for effect in self.effects:
            if not isinstance(effect, AbstractEffect):
                raise SceneError(f"{effect!r} is not an effect; make one, such as jaxeit.effects.LoadSpreading()")
        _check_numbers(self.effects)
        _check_alternatives(self.effects)
        _check_electrodes(self.effects, len(self.skin.electrodes))


def _check_numbers(effects: tuple[AbstractEffect, ...]) -> None:
    """JAX computes with every field that is not static."""
    for effect in effects:
        for path, leaf in tree_flatten_with_path(effect)[0]:
            if not eqx.is_array_like(leaf):
                name = keystr(path).lstrip(".")
                raise SceneError(
                    f"{type(effect).__name__}: {name} is {stated(leaf)}, and not a number; write the field as "
                    f"{name}: ... = equinox.field(static=True) where it is a choice"
                )


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

    Example:
        text = '[[effects]]\\ntype = "LoadSpreading"\\nwidth = 0.01'
        print(je.toml.parse_toml(text, "scene", je.model.read_effects))
    """
    return tuple(map(_read_effect, table.tables("effects")))


def _read_effect(table: TomlTable) -> AbstractEffect:
    effect = EFFECTS.read(table)
    for name in type(effect).to_be_set:
        if not table.has(name):
            raise table.error(
                name, f"{type(effect).__name__} has no usual value of it; set it in the unit of its stream"
            )
    return effect
