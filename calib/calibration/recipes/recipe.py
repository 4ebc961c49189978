"""The recipe of a calibration: every choice that is made on the way from sessions to newtons, as one object."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import NoneType

import jaxeit as je
from jaxeit.messages.kinds import require_kind
from jaxeit.toml import parse_toml, read_text

from ...fitting.curves import AbstractCurve, Linear
from ...fitting.fields import AbstractField
from ...fitting.losses import AbstractLoss, SoftL1
from ...presses.table import Processing
from ..localisation.locators import AbstractLocatorChoice, FittedContact
from .text import SWITCHES, recipe_fields, recipe_to_toml

_KINDS: dict[str, tuple[type, str, str]] = {
    "curve": (AbstractCurve, "a curve", "calib.PowerLaw()"),
    "location": (AbstractField, "a field", "calib.PadEdgeSpline()"),
    "locator": (AbstractLocatorChoice, "a choice of locator", "calib.calibration.FittedContact()"),
    "loss": (AbstractLoss, "a loss", "calib.fitting.Huber()"),
    "processing": (Processing, "a processing", "calib.presses.Processing()"),
    "imaging": (je.Imaging, "an imaging", "je.Imaging(je.Pixels(40))"),
    "fidelity": (je.Fidelity, "a fidelity", "je.Fidelity.draft()"),
}
"""Class of each choice, the noun for it, and an example."""


class RecipeError(ValueError):
    """Choices that do not fit together; the message names them and says what to give.

    Example:
        try:
            calib.Recipe(folds=0)
        except calibration.RecipeError as error:
            print(error)
    """


@dataclass(frozen=True)
class Recipe:
    """How sessions become a calibration.

    | meaning                                                                                     | default          |
    |---------------------------------------------------------------------------------------------|------------------|
    | curve: pressure-force curve; of several curves, cross-validation chooses one                | `Linear`         |
    | location: gain as a function of the place, or None; of several, cross-validation chooses    | None             |
    | locator: estimator of the place of a contact, used if there is a field                      | `FittedContact`  |
    | loss: of the curve fits                                                                     | `SoftL1`         |
    | processing: how sessions are cut into presses and corrected                                 | `Processing`     |
    | folds: parts into which the places are divided; each is predicted from the others           | 5                |
    | imaging: how images are computed from frames                                                | `jaxeit.Imaging` |
    | fidelity: accuracy of the finite-element model from which images are computed               | standard         |
    | even_sheet: take the sheet for even; otherwise the untouched frames tell its conductivity   | False            |
    | fit_electrodes: put the electrodes where untouched frames and presses tell that they sit     | False            |
    | learn_layer: keep what the presses tell of the contact layer's gain, by which `apply` and    | False           |
    |   `live` then follow contacts                                                               |                  |

    The default is the recipe of the paper (arXiv 2605.28468), except that the paper takes the sheet for even. Sequences
    of curves and locations become tuples.

    Raises:
        RecipeError: if a name, a class or an object of another kind stands in the place of a choice, if no curve or
            location is given, if there is less than one fold, if the basis has no pixels, or if the hyperparameter has
            frames of its own, because the frames of the presses are used to choose it.
    """

    curve: AbstractCurve | Sequence[AbstractCurve] = field(default_factory=Linear)
    location: AbstractField | Sequence[AbstractField | None] | None = None
    locator: AbstractLocatorChoice = field(default_factory=FittedContact)
    loss: AbstractLoss = field(default_factory=SoftL1)
    processing: Processing = field(default_factory=Processing)
    folds: int = 5
    imaging: je.Imaging = field(default_factory=je.Imaging)
    fidelity: je.Fidelity = field(default_factory=je.Fidelity.standard)
    even_sheet: bool = False
    fit_electrodes: bool = False
    learn_layer: bool = False

    def __post_init__(self) -> None:
        for name in ("curve", "location"):
            choice = getattr(self, name)
            if isinstance(choice, Sequence) and not isinstance(choice, str):
                object.__setattr__(self, name, tuple(choice))
                if not choice:
                    raise RecipeError(f"recipe: {name} is empty; give one or more to choose from")
        self._require_kinds()
        if not isinstance(self.folds, int) or isinstance(self.folds, bool) or self.folds < 1:
            raise RecipeError(f"recipe: folds is {self.folds!r}; give a whole number above zero, an int")
        if isinstance(self.imaging.basis, je.model.Elements):
            raise RecipeError("recipe: pads are laid on an image of pixels; choose the basis Pixels or Bumps")
        weight = self.imaging.hyperparameter
        if isinstance(weight, je.imaging.AbstractFrameChoice) and weight.frames is not None:
            name = type(weight).__name__
            raise RecipeError(f"recipe: {name} has frames of its own; give {name}(), which looks at the presses")

    def _require_kinds(self) -> None:
        """Refuse names, classes and objects of another kind in the place of a choice."""
        for name, (kind, noun, example) in _KINDS.items():
            given = getattr(self, name)
            for choice in given if isinstance(given, tuple) and name in ("curve", "location") else (given,):
                if choice is not None or name != "location":
                    give = f"an object, such as {example} (names are for TOML and the command line)"
                    require_kind(choice, kind, RecipeError, noun, give, f"recipe: {name}")
        for name in SWITCHES:
            if not isinstance(getattr(self, name), bool):
                raise RecipeError(f"recipe: {name} is {getattr(self, name)!r}; give True or False")

    @classmethod
    def from_toml(
        cls, text: str, source: str = "recipe", *, base: "Recipe | None" = None, allow_import: bool = False
    ) -> "Recipe":
        """The recipe that a TOML text describes.

        Args:
            source: name of the text in error messages.
            base: recipe whose choices apply where the text gives none; default: `Recipe()`.
            allow_import: whether the text may name classes of the user's own by import path, whose modules are then
                imported; not for a text that a data file holds.

        Raises:
            TomlError: naming the source, the key and the reason.
        """
        start = base or cls()
        return parse_toml(text, source, lambda table: replace(start, **recipe_fields(table, start)), allow_import)

    @classmethod
    def load(cls, path: str | Path) -> "Recipe":
        """The recipe of a TOML file, as `from_toml`; the file may name classes by import path."""
        return cls.from_toml(read_text(Path(path)), str(path), allow_import=True)

    def to_toml(self) -> str:
        """The recipe as TOML, which `from_toml` reads."""
        return recipe_to_toml(self)

    @property
    def curves(self) -> tuple[AbstractCurve, ...]:
        """The curves to choose from."""
        return self.curve if isinstance(self.curve, tuple) else (self.curve,)

    @property
    def locations(self) -> tuple[AbstractField | None, ...]:
        """The fields to choose from."""
        return self.location if isinstance(self.location, tuple) else (self.location,)

    @property
    def locates(self) -> bool:
        """Whether any of the `locations` needs the place of a press."""
        return any(location is not None for location in self.locations)


def recipe_or_default(recipe: Recipe | None, call: str) -> Recipe:
    """The recipe that a ``call`` was given, or that of the paper.

    Raises:
        RecipeError: if it is no recipe, such as the path of one.
    """
    give = "one, such as calib.Recipe(curve=calib.Linear()) or calib.Recipe.load('recipe.toml')"
    require_kind(recipe, (Recipe, NoneType), RecipeError, "a recipe", give, call)
    return recipe or Recipe()
