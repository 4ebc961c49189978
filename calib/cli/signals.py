"""Signals that end a recording or a live show."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..record.recorder import StopRequest


@contextmanager
def orderly_end(orders: "StopRequest", planned: bool) -> Iterator[None]:
    """The first signal ends a recording in order, a second one at once; Ctrl-C is how one without end is ended."""
    import signal

    def tell(number: int, _frame: FrameType | None) -> None:
        if orders.stop.is_set():
            raise KeyboardInterrupt
        expected = number == signal.SIGINT and not planned
        orders.stop_recording(
            "" if expected else f"stopped by {signal.Signals(number).name}", 0 if expected else 128 + number
        )

    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]  # as nohup has it
    before = {number: signal.signal(number, tell) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
