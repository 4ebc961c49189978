"""Present live results to people and programs: the page, lines of JSON on a socket, and further viewers."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from ...calibration.calibration import Calibration
from ...calibration.logs.calibration import LogCalibration
from ...record.broadcast import Broadcaster, host_and_port
from ...record.plan import RecordingPlan
from ...record.recorder import session_journal
from ...record.sources import Source
from ..loop import LiveControl, LiveSettings, Publish, run_live
from ..results import Result
from .page import LOOPBACK, Page


@dataclass(frozen=True)
class Presentation:
    """Where results are shown.

    | field    | meaning                                                                                   |
    |----------|-------------------------------------------------------------------------------------------|
    | host     | address that the page and the lines of JSON listen on; default: this machine only           |
    | port     | port of the page; 0: any free port                                                        |
    | publish  | port of the lines of JSON, 0: any free port; None: no lines                                |
    | maps     | whether the lines of JSON hold map and image                                              |
    | output   | session file to which the streams are recorded at the same time; None: no recording        |
    """

    host: str = "127.0.0.1"
    port: int = 8765
    publish: int | None = None
    maps: bool = False
    output: str | Path | None = None


def present(
    calibration: Calibration | LogCalibration,
    plan: RecordingPlan,
    sources: Sequence[Source],
    control: LiveControl,
    where: Presentation | None = None,
    settings: LiveSettings | None = None,
    *,
    also: Sequence[Publish] = (),
    tell: Callable[[str], object] = lambda line: None,
) -> int:
    """Show results until a stop is requested; returns the number of processed frames.

    Args:
        plan, sources: from `plan_recording`, as for `run_live`.
        where: where results are shown.
        settings: how frames are processed.
        also: further functions that are called with each result.
        tell: called with messages for the operator, such as the address of the page.

    Raises:
        LiveError, PriorityError: as `run_live`.
        RecordError: as `session_journal`.
        OSError: if a port is in use.

    Example:
        from calib.live import Presentation, present

        control.stop.clear()
        plan, sources = plan_recording(urls, mine.skin)
        page = Presentation(port=0, publish=0)  # any free ports: of the page, and of lines of JSON
        present(mine, plan, sources, control, page, LiveSettings(rest=0.3), also=[show], tell=print)
    """
    where = where or Presentation()
    with ExitStack() as stack:
        with _named("--port", where.host, where.port):
            page = stack.enter_context(Page(calibration, control, where.host, where.port))
        viewers: list[Publish] = [page.show_result, *also]
        tell(f"look at {page.url}")
        if where.publish is not None:
            with _named("--publish", where.host, where.publish):
                lines = stack.enter_context(Broadcaster(where.host, where.publish))
            tell(f"lines of JSON at {host_and_port(*lines.address)}")
            shape = calibration.recon.shape if where.maps and isinstance(calibration, Calibration) else ()
            viewers.append(lambda result: lines.publish([_line(result, shape)]))
        if where.host not in LOOPBACK:
            tell("anyone who can reach this machine can view the page and measure the rest levels again")
        log = None if where.output is None else stack.enter_context(session_journal(where.output, tell))
        return run_live(calibration, plan, sources, viewers, control, settings, log=log)


@contextmanager
def _named(option: str, host: str, port: int) -> Iterator[None]:
    """The option and the address before what the system says about them."""
    try:
        yield
    except (OSError, OverflowError) as error:
        why = str(getattr(error, "strerror", None) or error).partition(" (while attempting")[0]
        raise OSError(
            f"{option}: {host_and_port(host, port)}: {why}; name another port (0: any free one) or --host"
        ) from None


def _line(result: Result, shape: tuple[int, ...]) -> bytes:
    return result.to_json(image=bool(shape), shape=shape).encode() + b"\n"
