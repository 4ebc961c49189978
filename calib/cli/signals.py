"""Handle signals that end a command, so that temporary files are removed and a recording is finished."""

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..record.recorder import StopRequest


# After which an interruption that was dropped is raised again; s.
AGAIN_AFTER = 0.05
# In which a second signal may end a command in order, before its process is ended; s.
LAST_GRACE = 1.0
ENDING_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class Terminated(KeyboardInterrupt):
    """A signal asked the program to end; handled like Ctrl-C, so that no incomplete file stays."""

    def __init__(self, number: int):
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.status = 128 + number


def interruption_status(interrupt: KeyboardInterrupt) -> int:
    """Exit status of a command that was interrupted, as a shell reports it."""
    return interrupt.status if isinstance(interrupt, Terminated) else 128 + signal.SIGINT


@contextmanager
def _raised_again() -> Iterator[None]:
    """Within this context an interruption that Python drops is raised again, a moment later.

    An exception that a signal raises inside a callback of the garbage collector, as JAX has one, is only printed.
    """
    usual = sys.unraisablehook

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if not isinstance(dropped.exc_value, KeyboardInterrupt):
            usual(dropped)
            return
        to = threading.main_thread().ident, interruption_status(dropped.exc_value) - 128
        again = threading.Timer(AGAIN_AFTER, signal.pthread_kill, to)
        again.daemon = True
        again.start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual


@contextmanager
def termination_raised() -> Iterator[None]:
    """Within this context SIGTERM and SIGHUP raise `Terminated`, unless ignored; in the main thread only.

    They and Ctrl-C end a command whatever it is doing.
    """

    def terminate(number: int, _frame: FrameType | None) -> None:
        raise Terminated(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [number for number in ENDING_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]  # ignored by nohup
    before = {number: signal.signal(number, terminate) for number in numbers}
    try:
        with _raised_again():
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def orderly_end(orders: "StopRequest", planned: bool) -> Iterator[None]:
    """Within this context the first signal ends a recording in order, and a second signal ends it at once.

    Ctrl-C is the normal end of a recording without a `planned` duration, so its exit status is then 0.
    """

    def tell(number: int, _frame: FrameType | None) -> None:
        if orders.stop.is_set():
            raise KeyboardInterrupt
        expected = number == signal.SIGINT and not planned
        orders.stop_recording(
            "" if expected else f"stopped by {signal.Signals(number).name}", 0 if expected else 128 + number
        )

    # nohup, for example, ignores SIGHUP, and the recording must then survive it.
    numbers = [n for n in (signal.SIGINT, *ENDING_SIGNALS) if signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, tell) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def heard_at_once(first: Callable[[], object], last: Callable[[], object]) -> Iterator[None]:
    """Within this context a thread hears signals while the main thread compiles, which handles none meanwhile.

    Args:
        first: called at the first signal that ends the command.
        last: called when a second one has not ended this context in `LAST_GRACE`; then the process ends.
    """
    ended, numbers = threading.Event(), (signal.SIGINT, *ENDING_SIGNALS)
    numbers = tuple(number for number in numbers if signal.getsignal(number) != signal.SIG_IGN)

    def listen() -> None:
        heard = 0
        while number := reader.recv(1):
            if number[0] not in numbers:
                continue
            heard += 1
            if heard == 1:
                first()
            elif not ended.wait(LAST_GRACE):
                last()
                os._exit(128 + number[0])

    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        listener = threading.Thread(target=listen, name="signals", daemon=True)
        listener.start()
        try:
            yield
        finally:
            ended.set()
            signal.set_wakeup_fd(before)
            writer.shutdown(socket.SHUT_WR)
            listener.join()
