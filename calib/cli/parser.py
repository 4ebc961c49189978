"""The parser of the command line: bad arguments end in one line, with the nearest name that is known."""

import argparse
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

from .terminal import plain


class _WholeNames(argparse.HelpFormatter):
    """Lines that end between words: names of options and choices hold hyphens, and are to be copied."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)


class CommandParser(argparse.ArgumentParser):
    """The parser of one command. ``words`` is the command line, for a command whose arguments depend on it."""

    words: Sequence[str] = ()

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"formatter_class": _WholeNames, **settings})

    def error(self, message: str) -> NoReturn:
        """End with exit status 2, and one line in place of the usage, which may be longer than the screen."""
        line = plain(" ".join(_nearest_choice(message).splitlines()))
        self.exit(2, f"{self.prog}: {line} ({self.prog} --help)\n")

    def refuse(self, others: Sequence[str]) -> NoReturn:
        """End with the first of the arguments that no parser took, and the nearest option."""
        word = next((word for word in others if word.startswith("-")), others[0]).partition("=")[0]
        from jaxeit.messages.spelling import did_you_mean  # on an error only: help answers at once

        near = did_you_mean(word, _options(self))
        self.error(f"{word}: not known" + (f"; {near}" if near else ""))


def _nearest_choice(message: str) -> str:
    """The message of argparse, with the nearest choice in place of many."""
    found = re.fullmatch(r"(argument .*): invalid choice: '(.*)' \(choose from (.*)\)", message)
    if not found:
        return message
    from jaxeit.messages.spelling import did_you_mean  # on an error only

    name, word, choices = found.groups()
    known = (choice.strip("'") for choice in choices.split(", "))
    return f"{name}: no {word!r}; " + did_you_mean(word, known, f"choose from {choices}")


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """The options of a parser and of its subcommands."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _options(command)
