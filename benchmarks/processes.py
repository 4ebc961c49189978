"""A tool in several processes at once, each of which does its share: what a peer of one thread can do on all cores."""

import multiprocessing
import os
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from .clock import Tool, seconds


class InProcesses:
    """A tool whose results are those of one process after the other.

    ``share(number, count)`` makes the tool of one of ``count`` processes, in that process. `last_seconds` is the time
    of the slowest process in the last call, without the transport between processes.
    """

    def __init__(self, share: Callable[[int, int], Tool]) -> None:
        context, count = multiprocessing.get_context("spawn"), os.cpu_count() or 1
        self.last_seconds, self.ends = float("nan"), []
        for number in range(count):
            mine, theirs = context.Pipe()
            context.Process(target=_work, args=(share, number, count, theirs), daemon=True).start()
            self.ends.append(mine)
        self.close = weakref.finalize(self, _stop, self.ends)
        _answers(self.ends)

    def __call__(self, sigma: np.ndarray) -> np.ndarray:
        for end in self.ends:
            end.send(sigma)
        spent, found = zip(*_answers(self.ends), strict=True)
        self.last_seconds = max(spent)
        return np.concatenate(found)


def _answers(ends: Sequence[Connection]) -> list[Any]:
    """What each process answers; the error of one that failed is raised here."""
    answers = [end.recv() for end in ends]
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer
    return answers


def _work(share: Callable[[int, int], Tool], number: int, count: int, end: Connection) -> None:
    """What each process does: the tool first, then its result and the seconds for each conductivity, until None."""
    try:
        tool = share(number, count)
        end.send("ready")
        while (sigma := end.recv()) is not None:
            end.send(seconds(tool, sigma))
    except Exception as error:
        end.send(error)


def _stop(ends: Sequence[Connection]) -> None:
    for end in ends:
        end.send(None)
