"""What a calibration records of its origin, its recipe and the choices that were made, and reading that back."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import jaxeit as je
from jaxeit.toml import TomlTable, parse_toml

from ...fitting.cross_validation.selection import ModelChoice
from ...fitting.curves import CURVES
from ...fitting.fields import FIELDS
from ...presses.table import Processing
from ..recipes.recipe import Recipe
from ..recipes.text import read_imaging, read_processing

T = TypeVar("T")


def describe(recipe: Recipe, recon: je.imaging.AbstractReconstructor, choice: ModelChoice) -> dict[str, str]:
    """Provenance of a calibration: its recipe, and the choices that were made by cross-validation."""
    return {
        "curve": CURVES.name_of(choice.curve),
        "location": "none" if choice.field is None else FIELDS.name_of(choice.field),
        "choice": choice.why,
        "pixels": "x".join(map(str, recon.shape[::-1])),
        "hyperparameter": recon.provenance["hyperparameter"],
        "image_rank": recon.provenance["rank"],
        "recipe": recipe.to_toml(),
    }


def recorded_recipe(provenance: Mapping[str, str]) -> Recipe | None:
    """The recipe that `describe` recorded; None for a file of an early version."""
    text = provenance.get("recipe")
    return None if text is None else Recipe.from_toml(text, "calibration: recipe")


def recorded_processing(provenance: Mapping[str, str]) -> Processing:
    """How the sessions were cut and corrected; the default for a file of an early version."""
    return _part(provenance, "processing", lambda table: read_processing(table, Processing()), Processing())


def recorded_imaging(provenance: Mapping[str, str]) -> je.Imaging | None:
    return _part(provenance, "imaging", lambda table: read_imaging(table, je.Imaging()), None)


def _part(provenance: Mapping[str, str], key: str, read: Callable[[TomlTable], T], otherwise: T) -> T:
    """Read one table of the recorded recipe alone, because other tables may name classes that are not installed."""
    if "recipe" not in provenance:
        return otherwise
    return parse_toml(provenance["recipe"], "calibration: recipe", lambda table: read(table.table(key)))
