"""Arguments that several commands take, and checks of them before the work begins."""

import argparse
import dataclasses
import errno
import os
from collections import ChainMap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

if TYPE_CHECKING:
    import jaxeit as je

    from ..calibration.localisation.proposals import ProposalChoice


T = TypeVar("T")


def add_settings_argument(parser: argparse.ArgumentParser, option: str, text: str, example: str) -> None:
    """An option that gives some settings of an object by their names."""
    parser.add_argument(option, metavar="NAME=VALUE,...", help=f"{text}, such as {example}")


def settings_of_option(args: argparse.Namespace, name: str, kind: type[T]) -> T | None:
    """The object with the settings of an option; None where the option is not given.

    Raises:
        ValueError: naming the option, the setting and what to give.
    """
    from jaxeit.registry import from_words

    text = getattr(args, name)
    return None if text is None else from_words(kind, text, "--" + name.replace("_", "-"))


def of_option(name: str, text: str, make: Callable[[str, bool], T]) -> T:
    """What a registry makes of the text of an option, which may name a class by its import path.

    Raises:
        ValueError: naming the option.
    """
    try:
        return make(text, True)
    except ValueError as error:
        raise ValueError(f"--{name}: {error}") from None


def add_tracking_arguments(parser: argparse.ArgumentParser, text: str) -> None:
    """The options that follow contacts from frame to frame."""
    parser.add_argument("--track", action="store_true", help=text)
    add_settings_argument(parser, "--tracker", "as --track, with settings of jaxeit.tracking.TrackerSettings", "most=5")
    text = "with --track: the gain of the contact layer stays as the calibration has it; by default contacts teach it"
    parser.add_argument("--no-learn", action="store_true", help=text)
    text = "with --track: part of the variance that contacts took from that gain, which an hour gives back; default: 0"
    parser.add_argument("--forget", type=float, metavar="PART", help=text)
    text = (
        "with --track: depth of the sheet below the tips in an elastic half-space, m, by which loads spread; "
        "0: loads are Gaussian; default: as the presses of the calibration tell"
    )
    parser.add_argument("--depth", type=float, metavar="METRES", help=text)


def tracking_of(args: argparse.Namespace) -> "bool | je.tracking.TrackerSettings":
    """Whether contacts are followed; with the settings of the options, or the usual ones.

    Raises:
        ValueError: if an option is about contacts that are not followed, or a setting cannot be.
    """
    from jaxeit.tracking import TrackerSettings

    settings = settings_of_option(args, "tracker", TrackerSettings)
    usual = settings or TrackerSettings()
    changes: dict[str, dict[str, Any]] = {"--no-learn": {"learn": False}} if args.no_learn else {}
    changes |= {} if args.forget is None else {"--forget": {"forgetting": args.forget}}
    if args.depth is not None:
        changes["--depth"] = {"loads": dataclasses.replace(usual.loads, depth=args.depth)}
    if settings is None and not args.track:
        if changes:
            option = next(iter(changes))
            raise ValueError(f"{option}: it is about contacts that are followed; add --track, or leave it out")
        return False
    if changes:
        return dataclasses.replace(usual, **dict(ChainMap(*changes.values())))
    return True if settings is None else settings


def count(text: str) -> int:
    """A whole number above zero."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: give a whole number above zero")
    return int(text)


def above_zero(text: str) -> float:
    """A number above zero."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: give a number above zero")
    return value


def at_least_zero(text: str) -> float:
    """A number of zero or more."""
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: give a number of zero or more")
    return value


def part(text: str) -> float:
    """A number from zero to one."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text}: give a number from 0 to 1")
    return value


def percent(text: str) -> float:
    """A number above zero, at most one hundred."""
    value = float(text)
    if not 0 < value <= 100:
        raise argparse.ArgumentTypeError(f"{text}: give a number above zero, at most 100")
    return value


LAST_PORT = 65535


def port(text: str) -> int:
    """A port of TCP; 0 stands for any free one."""
    if not (text.isascii() and text.isdecimal()) or int(text[:10]) > LAST_PORT:
        raise argparse.ArgumentTypeError(f"{text}: give a port from 1 to {LAST_PORT}, or 0 for any free one")
    return int(text)


@overload
def skin_of(name: str) -> "je.Skin": ...


@overload
def skin_of(name: str | None) -> "je.Skin | None": ...


def skin_of(name: str | None) -> "je.Skin | None":
    """Load a shipped skin by its name, or the skin of a TOML file; None for None."""
    if name is None:
        return None
    import jaxeit as je

    return je.load_skin(name)


def prepare_outputs(args: argparse.Namespace, *names: str) -> None:
    """Create the folders of the output files in the arguments of these names, before the work begins.

    Raises:
        ValueError: if a file cannot be written, is given twice, or would take the place of an input or of a session.
    """
    if any(getattr(args, name) == "" for name in names):
        raise ValueError("the name of an output is empty; give a file name")
    outputs = [Path(path) for name in names if (path := getattr(args, name))]
    inputs = [Path(word) for name, value in vars(args).items() if name not in names for word in _words(value)]
    for number, path in enumerate(outputs):
        _require_short_name(path)
        if path.is_dir():
            raise ValueError(f"{path}: is a folder; give a file name")
        if path.exists() and not path.is_file():
            raise ValueError(f"{path}: is a device or a pipe; give a file name")
        if any(_same(path, other) for other in inputs):
            raise ValueError(f"{path}: is also an input, which would be lost; give another name")
        if any(path.absolute() == other.absolute() for other in outputs[:number]):
            raise ValueError(f"{path}: is given for two outputs; give two names")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise ValueError(f"{path}: the folder cannot be written to; choose another")


def _require_short_name(path: Path) -> None:
    """Refuse a name that is too long for a file, or for the unfinished file beside it."""
    try:
        os.stat(path.parent / f".{path.name}.{'0' * 12}.tmp")
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise ValueError(f"{path.name[:40]}...: is too long for the name of a file; give a shorter one") from None


def prepare_results(args: argparse.Namespace, *names: str) -> None:
    """`prepare_outputs` for files that are no sessions, which take the place of none."""
    from ..session import require_no_session

    prepare_outputs(args, *names)
    for name in names:
        if path := getattr(args, name):
            require_no_session(Path(path))


def picture_kind(path: str) -> str:
    """The format of a picture by the end of its name: png, pdf or svg; ValueError for another end."""
    kind = Path(path).suffix.lower()[1:]
    if kind not in ("png", "pdf", "svg"):
        raise ValueError(f"{path}: give a name that ends in .png, .pdf or .svg")
    return kind


def _words(value: object) -> list[str]:
    """The words in the value of an argument."""
    if dataclasses.is_dataclass(value):
        value = list(vars(value).values())
    if isinstance(value, list | tuple):
        return [word for each in value for word in _words(each)]
    return [value] if isinstance(value, str) else []


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except (OSError, ValueError):  # one of them does not exist, or is no path
        return False


NO_PROPOSAL = "none"


def add_proposal_argument(parser: argparse.ArgumentParser, what: str) -> None:
    """Add --proposal: `what` a proposal is for."""
    text = f"{what}; default: the one shipped for the skin, if there is one; {NO_PROPOSAL}: do without"
    parser.add_argument("--proposal", metavar="PROPOSAL.npz", help=text)


def proposal_of(given: str | None) -> "ProposalChoice":
    """The choice that --proposal names."""
    from jaxeit.contacts import load_proposal, shipped_proposal

    if given is None:
        return shipped_proposal
    return None if given == NO_PROPOSAL else load_proposal(given)


def require_optax() -> None:
    """Raise ImportError before the work begins if optax, which trains, is not installed."""
    from importlib.util import find_spec

    if find_spec("optax") is None:
        raise ImportError("jaxeit train needs optax: pip install 'jaxeit[train]'")


def require_matplotlib_for(option: str) -> None:
    """Raise ImportError before the work begins if matplotlib, which the option needs, is not installed."""
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        raise ImportError(f"{option} needs matplotlib: pip install 'jaxeit[report]'")
