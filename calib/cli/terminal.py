"""Progress and messages that commands show on a terminal."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from .signals import interruption_status

if TYPE_CHECKING:
    import jaxeit as je

LONG_NODES = 5000
"""Number of mesh nodes with which the first voltages take about 10 s, including mesh and compilation."""


def plain(text: object) -> str:
    """A text with "?" in place of control characters: names in files are not trusted, and a terminal obeys these."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in str(text))


def show(text: object) -> None:
    """Print results for a reader on standard output, without control characters."""
    print(plain(text), flush=True)


def say(line: str) -> None:
    """Print a line about the work on standard error, where it does not mix with results."""
    print(f"jaxeit: {plain(' '.join(line.splitlines()))}", file=sys.stderr, flush=True)


def say_interrupted(interrupt: KeyboardInterrupt, what: str) -> int:
    """Say that the work was interrupted, and ``what`` is left of it; returns the exit status."""
    say(f"{str(interrupt) or 'interrupted'}; {what}")
    return interruption_status(interrupt)


@contextmanager
def after_writing(output: str) -> Iterator[None]:
    """Within this context an interruption says that ``output`` is written, as its note."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        interrupt.add_note(f"{output} is written")
        raise


def one_line(error: Exception) -> str:
    """The message of an error, on one line."""
    return plain(" ".join(str(error).split())) or type(error).__name__


def title(names: str, simulated: bool) -> str:
    """The title of a table of results; it begins with SIMULATED if the data were simulated."""
    return ("SIMULATED, " if simulated else "") + names


def progress_bar(text: str) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """A wrapper of an iterable that shows a progress bar; no bar if standard error is no terminal."""
    from tqdm import tqdm

    return partial(tqdm, desc=plain(text), disable=None, leave=False)


@contextmanager
def stage_bar(count: int) -> Iterator[Callable[[str], None]]:
    """A progress bar of `count` stages; call its value with the name of each stage when the stage begins."""
    from tqdm import tqdm

    with tqdm(total=count, disable=None, leave=False) as bar:

        def begin(stage: str) -> None:
            bar.set_description(plain(stage))
            bar.update()

        yield begin


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """A status line that overwrites itself; no output if standard error is no terminal."""
    if not sys.stderr.isatty():
        yield lambda line: None
        return
    try:
        yield lambda line: print(f"\r\033[K{plain(line)}", end="", file=sys.stderr, flush=True)
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def announce_model(skin: "je.Skin", fidelity: "je.Fidelity") -> None:
    """Say on standard error what a command begins to compute, if that takes longer than about 10 s."""
    import jaxeit as je

    nodes = je.model.expected_mesh_nodes(skin, fidelity)
    if nodes > LONG_NODES:
        sizes = f"{len(skin.electrodes)} electrodes, {skin.protocol.readings:,} readings, about {nodes:,} mesh nodes"
        say(f"{skin.name}: {sizes}: this takes a while")


def file_size(path: str) -> int:
    """Bytes of a file; 0 if there is none."""
    return os.path.getsize(path) if os.path.isfile(path) else 0


@contextmanager
def byte_bar(total: int, text: str) -> Iterator[Callable[[int], object]]:
    """A progress bar of `total` bytes; call its value with the number of bytes done since the last call."""
    from tqdm import tqdm

    with tqdm(total=total, desc=plain(text), unit="B", unit_scale=True, disable=None, leave=False) as bar:
        yield bar.update
