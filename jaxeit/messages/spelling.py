"""The known name that a misspelt one is nearest to, for messages."""

import difflib
from collections.abc import Iterable

__all__ = ["did_you_mean", "nearest"]


def did_you_mean(word: str, known: Iterable[str], otherwise: str = "") -> str:
    """``did you mean 'name'?`` with the nearest of the known names; ``otherwise`` if none is near."""
    near = nearest(word, known)
    return f"did you mean {near!r}?" if near else otherwise


def nearest(word: str, known: Iterable[str], least: float = 0.6) -> str:
    """The known name that is most similar to a word; empty if the similarity of all is below ``least``, 0 to 1."""
    return next(iter(difflib.get_close_matches(word, list(known), 1, least)), "")
