"""A live show for people and for programs: the page, lines of JSON on a socket, lines on standard output."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from calib.calibration import Calibration

from .broadcast import Broadcaster
from .live import Publish, Show, live
from .plan import Plan
from .recorder import kept
from .results import Result
from .sources import Source
from .web import LOOPBACK, Page


def present(
    calibration: Calibration,
    plan: Plan,
    sources: Sequence[Source],
    show: Show,
    *,
    host: str = "127.0.0.1",
    port: int = 8765,
    publish: int | None = None,
    also: Sequence[Publish] = (),
    output: str | Path | None = None,
    event_driven: bool = False,
    realtime: bool = False,
    tell: Callable[[str], object] = lambda line: None,
    rest: float = 2.0,
    wait: float = 10.0,
) -> int:
    """Show results until told to stop; the number of frames worked on.

    Args:
        plan, sources: of eit and pressure, from `prepare`.
        host, port: of the page, 0 for any port; `publish`: of the lines of JSON, or None.
        also: told each result as well.
        output: a session file to record into meanwhile.
        tell: told where to look.
        event_driven, realtime, rest, wait: as in `live`.

    Raises:
        LiveError, PriorityError: as `live`. RecordError: as `kept`. OSError: if a port is taken.
    """
    with ExitStack() as stack:
        page = stack.enter_context(Page(calibration, show, host, port))
        out: list[Publish] = [page.show_result, *also]
        tell(f"look at {page.url}")
        if publish is not None:
            lines = stack.enter_context(Broadcaster(host, publish))
            tell(f"lines of JSON at {lines.address[0]}:{lines.address[1]}")
            out.append(lambda result: lines.say([result.to_json().encode() + b"\n"]))
        if host not in LOOPBACK:
            tell("anyone who can reach this machine can look, and set to zero")
        log = None if output is None else stack.enter_context(kept(output, tell))
        return live(
            calibration,
            plan,
            sources,
            lambda result: _all(out, result),
            show,
            log=log,
            event_driven=event_driven,
            realtime=realtime,
            rest=rest,
            wait=wait,
        )


def _all(out: Sequence[Publish], result: Result) -> None:
    for publish in out:
        publish(result)
