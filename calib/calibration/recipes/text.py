"""Recipes as TOML: every choice by its name in a registry, alone or with settings.

curve = ["linear", "power"]                       # several: one is chosen by cross-validation; or "auto", "memoryless"
location = {type = "edge", width = 0.008}         # or "edge:width=0.008", as on the command line
fidelity = "standard"
even_sheet = false
fit_electrodes = false
learn_layer = false

[imaging]
method = "one-step"
prior = "gaussian-smooth:length=0.01"
hyperparameter = 0.1                              # or "l-curve"

[processing]
corrections = ["low-pass:cutoff=20"]
baseline = "two-sided"
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import jaxeit as je
from jaxeit.registry import Registry
from jaxeit.toml import TomlTable

from ...fitting.curves import CURVES, AbstractCurve
from ...fitting.fields import FIELDS, AbstractField
from ...fitting.losses import LOSSES
from ...presses.corrections import BASELINES, CORRECTIONS
from ...presses.table import Processing
from ...presses.timing.windows import WindowLengths
from ..localisation.locators import LOCATORS

if TYPE_CHECKING:
    from .recipe import Recipe

T = TypeVar("T")

AUTO = "auto"
MEMORYLESS = "memoryless"
MEMORYLESS_CURVES = ("linear", "power", "polynomial", "spline")
"""Curves that ``memoryless`` stands for: zero at zero pressure, so that idle pads add nothing."""
AUTO_CURVES = (*MEMORYLESS_CURVES, "play", "hysteresis", "hysteresis-spline")
"""Curves that ``auto`` stands for: also those with memory, whose force depends on the pressures before."""
NONE = "none"
DEFAULT = "default"  # corrections: a low-pass where a stream holds something to remove
FIDELITY_LEVELS: Mapping[str, Callable[..., je.Fidelity]] = {
    "draft": je.Fidelity.draft,
    "standard": je.Fidelity.standard,
    "reference": je.Fidelity.reference,
}
SWITCHES = ("even_sheet", "fit_electrodes", "learn_layer")
"""Fields of a recipe that are true or false."""

# --- choices by name, as words ---------------------------------------------------------------------------------------


def curve_choice(text: str, allow_import: bool = False) -> AbstractCurve | tuple[AbstractCurve, ...]:
    """The curve of a word such as ``power:reference=900``; of ``auto`` and ``memoryless`` the curves they stand for."""
    if text in (AUTO, MEMORYLESS):
        return tuple(CURVES.make(name) for name in (AUTO_CURVES if text == AUTO else MEMORYLESS_CURVES))
    return CURVES.make(text, allow_import)


def location_choice(text: str, allow_import: bool = False) -> AbstractField | tuple[AbstractField | None, ...] | None:
    """The field of a word such as ``edge``; None for ``none``, and for ``auto`` none and all the shipped fields."""
    if text == AUTO:
        return (None, *(FIELDS.make(name) for name in FIELDS.shipped))
    return None if text == NONE else FIELDS.make(text, allow_import)


def hyperparameter_choice(text: str, allow_import: bool = False) -> float | je.imaging.AbstractHyperparameter:
    """A number, or the way to choose one of a word such as ``noise-figure:target=0.5``, or ``noise-figure:0.5``."""
    try:
        return float(text)
    except ValueError:
        name, _, rest = text.partition(":")
        if name == "noise-figure" and rest and "=" not in rest:
            text = f"{name}:target={rest}"
        return je.imaging.HYPERPARAMETERS.make(text, allow_import)


def fidelity_choice(text: str, allow_import: bool = False) -> je.Fidelity:
    """The fidelity of a word: ``draft``, ``standard`` or ``reference``, with settings as in ``draft:order=2``."""
    name, settings = je.registry.split_word(text)
    return _fidelity(TomlTable({"level": name, **settings}, f"fidelity {text!r}", allow_import))


# --- from TOML -------------------------------------------------------------------------------------------------------


def recipe_fields(table: TomlTable, base: "Recipe") -> dict[str, Any]:
    """The fields that a recipe's table gives, the others as in ``base``.

    Raises:
        TomlError: for a key or a name that is not known, or a value of the wrong kind.
    """
    read: dict[str, Callable[[], Any]] = {
        "curve": lambda: _one_or_several(table, "curve", CURVES, curve_choice),
        "location": lambda: _one_or_several(table, "location", FIELDS, location_choice),
        "locator": lambda: _choice(table, "locator", LOCATORS),
        "loss": lambda: _choice(table, "loss", LOSSES),
        "folds": lambda: table.count("folds"),
        "fidelity": lambda: _read_fidelity(table),
        **{name: partial(_read_switch, table, name) for name in SWITCHES},
        "imaging": lambda: read_imaging(table.table("imaging"), base.imaging),
        "processing": lambda: read_processing(table.table("processing"), base.processing),
    }
    found = {name: reader() for name, reader in read.items() if table.has(name)}
    table.done()
    return found


def _choice(table: TomlTable, key: str, registry: Registry[T], make: Callable[[str, bool], Any] | None = None) -> Any:
    """A choice by its word, or by a table of ``type`` and settings."""
    known = ", ".join(registry)
    value = table.get(key, lambda v: isinstance(v, str | dict), f"a {registry.kind} by its name: {known}")
    if isinstance(value, dict):
        return registry.read(table.table(key))
    return _made(table, key, value, make or registry.make)


def _made(table: TomlTable, key: str, text: str, make: Callable[[str, bool], Any]) -> Any:
    try:
        return make(text, table.allow_import)
    except ValueError as error:
        raise table.error(key, str(error)) from None


def _one_or_several(table: TomlTable, key: str, registry: Registry[T], make: Callable[[str, bool], Any]) -> Any:
    value = table.get(key, lambda v: isinstance(v, str | dict | list), f"a {registry.kind}, or a list of them")
    if not isinstance(value, list):
        return _choice(table, key, registry, make)
    rows = [TomlTable({key: one}, table.where, table.allow_import) for one in value]
    return tuple(_choice(row, key, registry, make) for row in rows)


def read_imaging(table: TomlTable, base: je.Imaging) -> je.Imaging:
    """The imaging of a table, with what it leaves out as in ``base``."""
    imaging = je.imaging
    registries: Mapping[str, Registry[Any]] = {
        "basis": je.model.BASES,
        "method": imaging.METHODS,
        "prior": imaging.PRIORS,
        "noise": imaging.NOISES,
    }
    found = {key: _choice(table, key, registry) for key, registry in registries.items() if table.has(key)}
    if table.has("hyperparameter"):
        found["hyperparameter"] = _read_hyperparameter(table)
    table.done()
    try:
        return replace(base, **found)
    except ValueError as error:
        raise table.error("method", str(error)) from None


def _read_hyperparameter(table: TomlTable) -> float | je.imaging.AbstractHyperparameter:
    key = "hyperparameter"
    if isinstance(table.get(key, lambda v: True, ""), str | dict):
        chosen: float | je.imaging.AbstractHyperparameter = _choice(
            table, key, je.imaging.HYPERPARAMETERS, hyperparameter_choice
        )
        return chosen
    return table.positive(key, "a number, or a way to choose one: " + ", ".join(je.imaging.HYPERPARAMETERS))


def read_processing(table: TomlTable, base: Processing) -> Processing:
    """The processing of a table, with what it leaves out as in ``base``."""
    found: dict[str, Any] = {}
    if table.has("corrections"):
        found["corrections"] = _corrections(table)
    if table.has("baseline"):
        found["baseline"] = _choice(table, "baseline", BASELINES)
    if table.has("windows"):
        windows, usual = table.table("windows"), base.windows
        names = [f.name for f in fields(WindowLengths)]
        found["windows"] = WindowLengths(**{n: windows.number(n, "seconds", getattr(usual, n)) for n in names})
        windows.done()
    table.done()
    return replace(base, **found)


def _corrections(table: TomlTable) -> tuple[Any, ...] | None:
    """The corrections in order; None for `DEFAULT`."""
    value = table.get("corrections", lambda v: v == DEFAULT or isinstance(v, list), f'a list, or "{DEFAULT}"')
    if value == DEFAULT:
        return None
    rows = [TomlTable({"corrections": one}, table.where, table.allow_import) for one in value]
    return tuple(_choice(row, "corrections", CORRECTIONS) for row in rows)


def _read_switch(table: TomlTable, name: str) -> bool:
    found: bool = table.get(name, lambda v: isinstance(v, bool), "true or false")
    return found


def _read_fidelity(table: TomlTable) -> je.Fidelity:
    known = ", ".join(FIDELITY_LEVELS)
    value = table.get("fidelity", lambda v: isinstance(v, str | dict), f"one of {known}, or a table")
    if isinstance(value, dict):
        return _fidelity(table.table("fidelity"))
    fidelity: je.Fidelity = _made(table, "fidelity", value, fidelity_choice)
    return fidelity


def _fidelity(table: TomlTable) -> je.Fidelity:
    level = table.choice("level", *FIDELITY_LEVELS, default="standard")
    settings = je.registry.settings_of(je.Fidelity, (je.linalg.SOLVERS,))
    changes = {name: setting.read(table) for name, setting in settings.items() if table.has(name)}
    if table.has("dtype"):
        changes["dtype"] = table.choice("dtype", "float32", "float64")
    table.done()
    try:
        return FIDELITY_LEVELS[level](**changes)
    except ValueError as error:
        raise table.error("fidelity", str(error)) from None


# --- to TOML ---------------------------------------------------------------------------------------------------------


def recipe_to_toml(recipe: "Recipe") -> str:
    """A recipe as TOML, with the settings of every choice."""
    imaging, processing = recipe.imaging, recipe.processing
    corrections = processing.corrections
    top = {
        "curve": _several(recipe.curve, CURVES),
        "location": _several(recipe.location, FIELDS),
        "locator": LOCATORS.settings(recipe.locator),
        "loss": LOSSES.settings(recipe.loss),
        "folds": recipe.folds,
        "fidelity": _fidelity_settings(recipe.fidelity),
        **{name: getattr(recipe, name) for name in SWITCHES},
    }
    weight = imaging.hyperparameter
    images = {
        "basis": je.model.BASES.settings(imaging.basis),
        "method": je.imaging.METHODS.settings(imaging.method),
        "prior": je.imaging.PRIORS.settings(imaging.prior),
        "hyperparameter": (
            je.imaging.HYPERPARAMETERS.settings(weight)
            if isinstance(weight, je.imaging.AbstractHyperparameter)
            else float(weight)
        ),
        "noise": je.imaging.NOISES.settings(imaging.noise),
    }
    cuts = {
        "corrections": DEFAULT if corrections is None else [CORRECTIONS.settings(c) for c in corrections],
        "baseline": BASELINES.settings(processing.baseline),
        "windows": {f.name: getattr(processing.windows, f.name) for f in fields(WindowLengths)},
    }
    return "\n".join([_lines(top), "", "[imaging]", _lines(images), "", "[processing]", _lines(cuts)])


def _several(choice: Any, registry: Registry[Any]) -> Any:
    if isinstance(choice, tuple):
        return [_several(one, registry) for one in choice]
    return NONE if choice is None else registry.settings(choice)


def _fidelity_settings(fidelity: je.Fidelity) -> dict[str, Any]:
    """All numbers of a fidelity; a level does not name them, as its numbers may change."""
    settings = je.registry.settings_of(je.Fidelity, (je.linalg.SOLVERS,))
    plain = {name: setting.plain(getattr(fidelity, name)) for name, setting in settings.items()}
    return {name: value for name, value in plain.items() if value is not None} | {"dtype": str(fidelity.dtype)}


def _lines(values: Mapping[str, Any]) -> str:
    return "\n".join(f"{key} = {_toml(value)}" for key, value in values.items())


def _toml(value: Any) -> str:
    """A value as TOML writes it; a table of ``type`` alone is its name."""
    if isinstance(value, Mapping):
        if set(value) == {"type"}:
            return _toml(value["type"])
        return "{" + ", ".join(f"{key} = {_toml(part)}" for key, part in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{_escaped(value)}"' if isinstance(value, str) else repr(value)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')
