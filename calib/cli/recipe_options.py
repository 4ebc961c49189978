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
from ..calibration.recipes.text import (
    AUTO,
    DEFAULT,
    FIDELITY_LEVELS,
    MEMORYLESS,
    NONE,
    SWITCHES,
    curve_choice,
    fidelity_choice,
    hyperparameter_choice,
    location_choice,
)
from ..fitting import CURVES, FIELDS, LOSSES
from ..presses.corrections import BASELINES, CORRECTIONS, AbstractCorrection, LowPass
from ..presses.table import Processing
from .arguments import above_zero, count, of_option

T = TypeVar("T")

IMAGING = ("method", "prior", "hyperparameter", "pixels", "basis", "noise")
"""Options that choose how images are made."""


def add_recipe_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for every choice of a recipe."""
    about = "a choice is a name, or a name with settings such as power:reference=900; module:Class is your own class"
    group = parser.add_argument_group("recipe", about)
    text = "take the choices from a TOML file; options given beside it override the file"
    group.add_argument("--recipe", metavar="RECIPE.toml", help=text)
    text = (
        "curve of force against pressure; auto chooses it by cross-validation over places, memoryless among those "
        "without hysteresis alone, in less time"
    )
    _choice(group, "--curve", (*CURVES, AUTO, MEMORYLESS), text, default="linear")
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
    _choice(group, "--fidelity", FIDELITY_LEVELS, "accuracy of the finite-element model", default="standard")
    text = "assume that the sheet is even; default: its conductivity is fitted to the untouched frames"
    _switch(group, "--even-sheet", text)
    text = (
        "move the electrodes to the places that untouched frames and presses show; the places of presses must be right"
    )
    _switch(group, "--fit-electrodes", text)
    text = "learn the gain of the contact layer from the presses; it improves apply `--loads`, `--track`"
    _switch(group, "--learn-layer", text)
    _choice(group, "--baseline", BASELINES, "baseline that is subtracted from a press", default="two-sided")
    add_correction_arguments(group)
    add_imaging_arguments(parser)


def add_correction_arguments(parser: Any, default: str = "a low-pass of 50 Hz on streams above 100 Hz") -> None:
    """The options of what is applied to every stream."""
    text = "correction of every stream; repeat the option for several, in order"
    _choice(parser, "--correction", (NONE, DEFAULT, *CORRECTIONS), text, default, action="append")
    text = "cutoff of the low-pass filter; other corrections stay"
    parser.add_argument("--low-pass", type=above_zero, metavar="HZ", help=text)


def _switch(parser: Any, option: str, text: str) -> None:
    """An option that is on, off with a ``no-`` before its name, or as in the recipe file where it is not given."""
    parser.add_argument(option, action=argparse.BooleanOptionalAction, default=None, help=text)


def add_imaging_arguments(
    parser: argparse.ArgumentParser, hyperparameter: str = "0.1", *, with_noise: bool = True
) -> None:
    """Options for how images are made.

    Args:
        hyperparameter: that of images where the option is not given.
        with_noise: whether the weights of the readings are a choice.
    """
    group = parser.add_argument_group("images")
    imaging = je.imaging
    _choice(group, "--method", imaging.METHODS, "reconstruction method", default="one-step")
    _choice(group, "--prior", imaging.PRIORS, "prior of the image", default="noser")
    text = "weight of the prior, or a method to choose it, such as noise-figure:0.5"
    names = ("a number", *imaging.HYPERPARAMETERS)
    _choice(group, "--hyperparameter", names, text, default=hyperparameter)
    either = group.add_mutually_exclusive_group()
    either.add_argument("--pixels", type=count, metavar="N", help="pixels along x; default: 40")
    _choice(either, "--basis", je.model.BASES, "basis functions of the image", default="pixels")
    if with_noise:
        text = "weights of the readings: equal, by their noise at rest, or by the covariance of that noise"
        _choice(group, "--noise", imaging.NOISES, text, default="equal")


def _choice(parser: Any, option: str, names: Iterable[str], text: str, default: str, action: str = "store") -> None:
    names = tuple(names)
    text = f"{text} (default: {default}); one of {', '.join(names)}"
    added = parser.add_argument(option, metavar="NAME", help=text, action=action)
    # A choice may have settings, so that these are not all of its texts; a shell completes them.
    added.suggestions = tuple(name for name in names if " " not in name)


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
    given |= {name: getattr(args, name) for name in SWITCHES if getattr(args, name) is not None}
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
    given = {name: _made(args, name, of) for name, of in make.items() if getattr(args, name, None) is not None}
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
    return replace(base, corrections=_corrections(args, base.corrections))


def _corrections(
    args: argparse.Namespace, base: tuple[AbstractCorrection, ...] | None
) -> tuple[AbstractCorrection, ...] | None:
    """The corrections of the options, or those of ``base``, with the low-pass that the options give."""
    named = args.correction or []
    alone = next((one for one in named if one in (NONE, DEFAULT)), None)
    if alone is not None and len(named) > 1:
        raise ValueError(f"--correction {alone} stands alone; leave it out, or the others")
    if alone is not None:
        base = None if alone == DEFAULT else ()
    elif named:
        base = tuple(of_option("correction", one, CORRECTIONS.make) for one in named)
    if args.low_pass is None:
        return base
    kept = base or ()
    if not any(isinstance(one, LowPass) for one in kept):
        return LowPass(args.low_pass), *kept
    return tuple(replace(one, cutoff=args.low_pass) if isinstance(one, LowPass) else one for one in kept)


def refuse_corrections(args: argparse.Namespace) -> None:
    """Refuse corrections for the calibration of a log, which is made and used without them."""
    given = [option for option in ("correction", "low_pass") if getattr(args, option) is not None]
    if given:
        option = "--" + given[0].replace("_", "-")
        raise ValueError(f"{option}: for calibrations with EIT, and this one is of a log; leave it out")


def _made(args: argparse.Namespace, name: str, make: Callable[[str, bool], T]) -> T:
    return of_option(name, getattr(args, name), make)
