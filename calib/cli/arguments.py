"""Arguments that several commands take, and checks of them before the work begins."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:
    import jaxeit as je

    from ..calibration.localisation.proposals import ProposalChoice


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


def prepare_outputs(*paths: str | None) -> None:
    """Create the folders of output files; raises ValueError before the work begins if a file cannot be written."""
    for path in map(Path, filter(None, paths)):
        if path.is_dir():
            raise ValueError(f"{path}: is a folder; give a file name")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise ValueError(f"{path}: the folder cannot be written to; choose another")


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
