"""The interface of an import format: its arguments on the command line, and the conversion to a session."""

import argparse
from abc import ABC, abstractmethod
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from ..errors import SessionError, printable
from .reports import ImportReport
from .tables.table import Progress

if TYPE_CHECKING:  # a second to import, and only wanted with --skin
    import jaxeit as je


class StatedFacts(NamedTuple):
    """Facts about a recording that the user states, for any format.

    | field    | meaning                                                                             |
    |----------|-------------------------------------------------------------------------------------|
    | title    | of the session; "": made from the names of the files                                |
    | license  | licence of the recording                                                            |
    | epoch    | when the clock read zero, with a time zone; None: unknown                           |
    | skin     | on which the streams eit and pressure were recorded; None: they cannot be calibrated |
    | progress | wraps an iteration over lines, such as `tqdm.tqdm`                                  |
    """

    title: str = ""
    license: str = ""
    epoch: datetime | None = None
    skin: "je.Skin | None" = None
    progress: Progress = iter


class AbstractImporter(ABC):
    """A format of foreign recordings; ``name`` and ``summary`` are for the command line."""

    name: ClassVar[str]
    summary: ClassVar[str]

    @classmethod
    @abstractmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments of this format; those of `add_common_arguments` are added for every format."""

    @classmethod
    @abstractmethod
    def convert(cls, args: argparse.Namespace, output: Path, about: StatedFacts) -> ImportReport:
        """Write the session file that the arguments describe.

        Raises:
            SessionError: for what cannot be read or understood; nothing is written then.
        """


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that every format takes."""
    parser.add_argument("-o", "--output", required=True, metavar="SESSION", help="file to write")
    parser.add_argument("--title", default="", help="title of the session")
    parser.add_argument("--license", default="", help="licence of the recording")
    text = "the recorded skin, a shipped one or a TOML file; readings must be in the order of its protocol"
    parser.add_argument("--skin", help=text)
    parser.add_argument("--epoch", help="ISO time, with time zone, at which the clock read zero")


def parse_epoch(text: str | None) -> datetime | None:
    """The time of ``--epoch``; raises `SessionError` for a text that is no time, or has no time zone."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise SessionError(f"--epoch {printable(text)}: not a time; write it as 2025-01-31T12:00:00Z")
    try:
        moment.astimezone(UTC)
    except OverflowError:
        raise SessionError(
            f"--epoch {printable(text)}: lies outside of the years 1 to 9999 of UTC; correct it"
        ) from None
    return moment
