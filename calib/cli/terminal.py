"""What commands show on a terminal while they work."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jaxeit as je

LONG_NODES = 5000
"""Nodes of a mesh that take about 10 s from the skin to the first voltages, compilation included."""


def one_line(error: Exception) -> str:
    """What an error says, on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def title(names: str, simulated: bool) -> str:
    """The title of a table of results; it says first if they rest on a simulation."""
    return ("SIMULATED, " if simulated else "") + names


def progress_bar(text: str) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """A wrapper of an iterable that shows how far it is; it shows nothing where nobody watches."""
    from tqdm import tqdm

    return partial(tqdm, desc=text, disable=None, leave=False)


@contextmanager
def stage_bar(count: int) -> Iterator[Callable[[str], None]]:
    """A bar that is told the name of each stage as it begins."""
    from tqdm import tqdm

    with tqdm(total=count, disable=None, leave=False) as bar:

        def begin(stage: str) -> None:
            bar.set_description(stage)
            bar.update()

        yield begin


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """A line on the terminal that is written over; nothing where nobody watches."""
    if not sys.stderr.isatty():
        yield lambda line: None
        return
    try:
        yield lambda line: print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def announce_model(skin: "je.Skin", fidelity: "je.Fidelity") -> None:
    """Say on standard error what a command begins to compute, if that takes longer than about 10 s."""
    import jaxeit as je

    nodes = je.model.expected_mesh_nodes(skin, fidelity)
    if nodes > LONG_NODES:
        sizes = f"{len(skin.electrodes)} electrodes, {skin.protocol.readings:,} readings, about {nodes:,} mesh nodes"
        print(f"jaxeit: {skin.name}: {sizes}: this takes a while", file=sys.stderr, flush=True)


def file_size(path: str) -> int:
    """Bytes of a file; 0 if there is none."""
    return os.path.getsize(path) if os.path.isfile(path) else 0


@contextmanager
def byte_bar(total: int, text: str) -> Iterator[Callable[[int], object]]:
    """A bar that is told how many bytes more are done."""
    from tqdm import tqdm

    with tqdm(total=total, desc=text, unit="B", unit_scale=True, disable=None, leave=False) as bar:
        yield bar.update
