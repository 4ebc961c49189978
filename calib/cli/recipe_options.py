"""Options that name the choices of a recipe, and the recipe that they make.

Names come from the registries, so a new class needs no change here. An option overrides the recipe file, and the recipe
file overrides the defaults.
"""

import argparse
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, TypeVar

import jaxeit as je

from ..calibration import Recipe
from ..calibration.localisation.locators import LOCATORS
from ..calibration.recipe_text import (
    AUTO,
    LEVELS,
    NONE,
    SWITCHES,
    curve_choice,
    fidelity_choice,
    hyperparameter_choice,
    location_choice,
)
from ..fitting import CURVES, FIELDS, LOSSES
from ..presses.corrections import BASELINES, LowPass
from ..presses.table import Processing
from .arguments import above_zero, count

T = TypeVar("T")

IMAGING = ("method", "prior", "hyperparameter", "pixels", "basis", "noise")
"""Options that choose how images are made."""


def add_recipe_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for every choice of a recipe."""
    about = "a choice is a name, or a name with settings such as power:reference=900; module:Class is your own class"
    group = parser.add_argument_group("recipe", about)
    text = "take the choices from a TOML file; options given beside it override the file"
    group.add_argument("--recipe", metavar="RECIPE.toml", help=text)
    text = "curve of force against pressure; auto chooses it by cross-validation over places"
    _choice(group, "--curve", (*CURVES, AUTO), text, default="linear")
    text = "correction by location: gain over the estimated place of the contact; the paper's recipe has none"
    _choice(group, "--location", (NONE, *FIELDS, AUTO), text, default=NONE)
    _choice(group, "--locator", LOCATORS, "estimator of the place of a contact", default="fitted-contact")
    _choice(
        group,
        "--loss",
        LOSSES,
        "loss function of the curve fit, which limits the influence of outliers",
        default="soft-l1",
    )
    text = "folds of the cross-validation over places; with K of at least the number of places, "
    group.add_argument("--folds", type=count, metavar="K", help=text + "one place is left out at a time; default: 5")
    _choice(group, "--fidelity", LEVELS, "accuracy of the finite-element model", default="standard")
    text = "assume that the sheet is even; default: its conductivity is fitted to the untouched frames"
    group.add_argument("--even-sheet", action="store_true", help=text)
    text = (
        "move the electrodes to the places that untouched frames and presses show; the places of presses must be right"
    )
    group.add_argument("--fit-electrodes", action="store_true", help=text)
    text = "learn the gain of the contact layer from the presses; it improves apply `--loads`, `--track`"
    group.add_argument("--learn-layer", action="store_true", help=text)
    _choice(group, "--baseline", BASELINES, "baseline that is subtracted from a press", default="two-sided")
    add_low_pass_argument(group)
    add_imaging_arguments(parser)


def add_low_pass_argument(parser: Any) -> None:
    """The option of the low-pass filter."""
    text = "cutoff of the low-pass filter; default: 50, or no filter for streams of 100 Hz or slower"
    parser.add_argument("--low-pass", type=above_zero, metavar="HZ", help=text)


def add_imaging_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for how images are made."""
    group = parser.add_argument_group("images")
    imaging = je.imaging
    _choice(group, "--method", imaging.METHODS, "reconstruction method", default="one-step")
    _choice(group, "--prior", imaging.PRIORS, "prior of the image", default="noser")
    text = "weight of the prior, or a method to choose it, such as noise-figure:0.5"
    names = ("a number", *imaging.HYPERPARAMETERS)
    _choice(group, "--hyperparameter", names, text, default="0.1")
    either = group.add_mutually_exclusive_group()
    either.add_argument("--pixels", type=count, metavar="N", help="pixels along x; default: 40")
    _choice(either, "--basis", je.model.BASES, "basis functions of the image", default="pixels")
    text = "weights of the readings: equal, by their noise at rest, or by the covariance of that noise"
    _choice(group, "--noise", imaging.NOISES, text, default="equal")


def _choice(parser: Any, option: str, names: Iterable[str], text: str, default: str) -> None:
    names = tuple(names)
    text = f"{text} (default: {default}); one of {', '.join(names)}"
    action = parser.add_argument(option, metavar="NAME", help=text)
    # A choice may have settings, so that these are not all of its texts; a shell completes them.
    action.suggestions = tuple(name for name in names if " " not in name)


def recipe_of(args: argparse.Namespace) -> Recipe:
    """The recipe that the options make, on top of the recipe file if there is one.

    Raises:
        ValueError: naming the option or the file, what is wrong with it, and what to give.
    """
    recipe = Recipe() if args.recipe is None else Recipe.load(args.recipe)
    make: dict[str, Callable[[str, bool], Any]] = {
        "curve": curve_choice,
        "location": location_choice,
        "locator": LOCATORS.make,
        "loss": LOSSES.make,
        "fidelity": fidelity_choice,
    }
    given = {name: _made(args, name, of) for name, of in make.items() if getattr(args, name) is not None}
    given |= {} if args.folds is None else {"folds": args.folds}
    given |= {name: True for name in SWITCHES if getattr(args, name)}
    processing = processing_of(args, recipe.processing)
    recipe = replace(recipe, **given, processing=processing, imaging=imaging_of(args, recipe.imaging))
    if args.locator is not None and not recipe.locates:
        raise ValueError(f"--locator {args.locator}: nothing asks for the place; give --location too, such as edge")
    return recipe


def imaging_of(args: argparse.Namespace, base: je.Imaging) -> je.Imaging:
    """The imaging that the options make, with the rest as in ``base``."""
    make: dict[str, Callable[[str, bool], Any]] = {
        "method": je.imaging.METHODS.make,
        "prior": je.imaging.PRIORS.make,
        "hyperparameter": hyperparameter_choice,
        "basis": je.model.BASES.make,
        "noise": je.imaging.NOISES.make,
    }
    given = {name: _made(args, name, of) for name, of in make.items() if getattr(args, name) is not None}
    if args.pixels is not None:
        given["basis"] = je.Pixels(args.pixels)
    try:
        return replace(base, **given)
    except ValueError as error:
        options = ", ".join(f"--{name} {getattr(args, name)}" for name in given)
        raise ValueError(f"{options}: {error}") from None


def processing_of(args: argparse.Namespace, base: Processing) -> Processing:
    """The processing that the options make, with the rest as in ``base``."""
    if getattr(args, "baseline", None) is not None:
        base = replace(base, baseline=_made(args, "baseline", BASELINES.make))
    return base if args.low_pass is None else replace(base, corrections=(LowPass(args.low_pass),))


def refuse_low_pass(args: argparse.Namespace) -> None:
    """Refuse a filter for the calibration of a log, which is made and used without one."""
    if args.low_pass is not None:
        raise ValueError("--low-pass: for calibrations with EIT, and this one is of a log; leave it out")


def _made(args: argparse.Namespace, name: str, make: Callable[[str, bool], T]) -> T:
    try:
        return make(getattr(args, name), True)
    except ValueError as error:
        raise ValueError(f"--{name}: {error}") from None
