"""`jaxeit live`."""

import argparse
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from ...arguments import (
    above_zero,
    add_proposal_argument,
    add_tracking_arguments,
    port,
    prepare_outputs,
    proposal_of,
    tracking_of,
)
from ...signals import heard_at_once, orderly_end
from ...terminal import say

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager

    from ....calibration import Calibration, LogCalibration
    from ....live.loop import LiveControl, LiveSettings
    from ....record.plan import RecordingPlan
    from ....record.sources import Source


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A calibration, the URLs of its streams, the outputs of the results, and how frames are processed."""
    _add_stream_arguments(parser)
    _add_output_arguments(parser)
    text = "request the next readings from the device: few at rest, those around the contact during a contact"
    parser.add_argument("--event-driven", action="store_true", help=text)
    text = "follow contacts from frame to frame: each keeps its number, with ellipse and force"
    add_tracking_arguments(parser, text)
    add_proposal_argument(parser, "the network of jaxeit train that tells what touches the skin, in each frame")
    text = "let zero and relative gains of the pads follow their drift, and write the moved calibration"
    parser.add_argument("--recalibrate", metavar="NEW.h5", help=text)
    text = "use real-time scheduling (SCHED_FIFO), so that frames are processed promptly on a busy machine (Linux)"
    parser.add_argument("--realtime", action="store_true", help=text)


def _add_stream_arguments(parser: argparse.ArgumentParser) -> None:
    """The calibration, the devices, and for how long."""
    parser.add_argument("--calibration", required=True, metavar="CALIBRATION.h5")
    text = "URL of the EIT stream, as for jaxeit record; not for the calibration of a log"
    parser.add_argument("--eit", metavar="URL", help=text)
    text = "URL of the pressure stream; for the calibration of a log, URL of its sensor's stream"
    parser.add_argument("--pressure", required=True, metavar="URL", help=text)
    text = "URL of the stage, for the calibration of a log that corrects by location"
    parser.add_argument("--stage", metavar="URL", help=text)
    parser.add_argument(
        "--rest", type=above_zero, default=2.0, metavar="S", help="time without contact at the start; default: 2"
    )
    text = "time within which every device must begin to send; default: 10"
    parser.add_argument("--wait", type=above_zero, default=10.0, metavar="S", help=text)
    parser.add_argument("--seconds", type=above_zero, help="duration from the first frame on; default: until Ctrl-C")


def _add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """The page, the programs and the file that get the results."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on; default: this machine only")
    parser.add_argument("--port", type=port, default=8765, help="port of the page; 0: any free port; default: 8765")
    text = "send results as lines of JSON to programs that connect to this port; 0: any free port"
    parser.add_argument("--publish", type=port, metavar="PORT", help=text)
    text = "add map and image to the lines of --publish, as base64 of little-endian float32"
    parser.add_argument("--publish-maps", action="store_true", help=text)
    parser.add_argument("--json", action="store_true", help="print results as lines of JSON")
    text = "send results to the rerun viewer at HOST:PORT (default: 127.0.0.1:9876), or write them to FILE.rrd"
    parser.add_argument("--rerun", nargs="?", const="127.0.0.1:9876", metavar="HOST:PORT|FILE.rrd", help=text)
    text = "publish the topics of docs/ros.md as a node of ROS 2; needs ROS"
    parser.add_argument("--ros2", nargs="?", const="jaxeit", metavar="NODE", help=text)
    text = "serve the same topics to the Foxglove app on this port (default: 8766; 0: any free port)"
    parser.add_argument("--foxglove", nargs="?", type=port, const=8766, metavar="PORT", help=text)
    text = "first part of the topics of --ros2 and --foxglove (default: /skin)"
    parser.add_argument("--prefix", help=text)
    text = "frame of coordinates in which the skin lies, for --ros2 and --foxglove (default: skin)"
    parser.add_argument("--frame-id", metavar="FRAME", help=text)
    parser.add_argument("-o", "--output", metavar="SESSION.h5", help="record the streams at the same time")


def run(args: argparse.Namespace) -> int:
    """Show force maps until the user stops the command."""
    _check_options(args)
    _set_up_process(args)
    from ....calibration import load_calibration
    from ....live.loop import LiveControl, Publish
    from ....live.views.presentation import Presentation, present
    from ....record.recorder import StopRequest

    settings = _settings(args)
    prepare_outputs(args, "output", "recalibrate")
    calibration = load_calibration(args.calibration)
    plan, sources = _planned(args, calibration)
    orders = StopRequest()
    show = LiveControl(stop=orders.stop, warn=say)
    also: list[Publish] = [lambda result: print(result.to_json(), flush=True)] if args.json else []
    first, last = _heard(args, show)
    with orderly_end(orders, planned=False), heard_at_once(first, last), ExitStack() as stack:
        also += [stack.enter_context(viewer).show_result for viewer in _viewers(args, calibration, show)]
        count = present(
            calibration,
            plan,
            sources,
            show,
            Presentation(args.host, args.port, args.publish, args.publish_maps, args.output),
            settings,
            also=also,
            tell=say,
        )
    say(f"{count} frames" if count else f"0 frames: {show.state}")
    return orders.status


def _heard(args: argparse.Namespace, show: "LiveControl") -> "tuple[Callable[[], None], Callable[[], None]]":
    """What a first signal says while programs are compiled, and what is done before a second one ends the process."""
    from ....live.engine import PREPARING
    from ....live.loop import CHOOSING, COMPILING
    from ....record.recorder import journal_path

    def first() -> None:
        if show.state in (COMPILING, CHOOSING, PREPARING):
            say("ends after what is being compiled; Ctrl-C again to end now")

    def last() -> None:
        journal = None if args.output is None else journal_path(args.output)
        if journal is not None and show.state not in (COMPILING, CHOOSING):
            say(f"interrupted; `jaxeit recover {journal}` makes the session")
            return
        if journal is not None:
            journal.unlink(missing_ok=True)  # no device was asked yet
        say("interrupted; nothing was written")

    return first, last


def _check_options(args: argparse.Namespace) -> None:
    """Refuse options of an output that was not asked for."""
    if args.publish_maps and args.publish is None:
        raise ValueError("--publish-maps: it adds to the lines of --publish; add --publish PORT, or leave it out")
    for option, value in (("--prefix", args.prefix), ("--frame-id", args.frame_id)):
        if value is not None and args.ros2 is None and args.foxglove is None:
            raise ValueError(f"{option}: it is about topics; add --ros2 or --foxglove, or leave it out")


def _settings(args: argparse.Namespace) -> "LiveSettings":
    from ....live.loop import LiveSettings

    return LiveSettings(
        event_driven=args.event_driven,
        realtime=args.realtime,
        rest=args.rest,
        wait=args.wait,
        seconds=args.seconds,
        track=tracking_of(args),
        proposal=proposal_of(args.proposal),
        recalibrate=args.recalibrate is not None,
        moved=args.recalibrate,
    )


def _viewers(
    args: argparse.Namespace, calibration: "Calibration | LogCalibration", show: "LiveControl"
) -> "Iterator[AbstractContextManager[Any]]":
    """Further programs that see the results; each is opened before the next one is made."""
    if args.rerun is not None:
        from ....live.views.rerun_view import RerunView

        yield RerunView(calibration, show, args.rerun)
    if args.ros2 is None and args.foxglove is None:
        return
    from ....live.bridges import Bridge, FoxgloveServer, RosNode

    names = {name: value for name in ("prefix", "frame_id") if (value := getattr(args, name)) is not None}
    options: dict[str, Any] = {"track": bool(tracking_of(args)), "warn": say, **names}
    if args.ros2 is not None:
        yield Bridge(calibration, RosNode(args.ros2), **options)
    if args.foxglove is not None:
        server = FoxgloveServer(args.host, args.foxglove, warn=say)
        yield Bridge(calibration, server, **options)
        say(f"open {server.address} in Foxglove")


def _planned(
    args: argparse.Namespace, calibration: "Calibration | LogCalibration"
) -> tuple["RecordingPlan", "list[Source]"]:
    """The streams that the calibration needs, with their sources."""
    from ....calibration import Calibration
    from ....record.planning import plan_recording

    if isinstance(calibration, Calibration):
        if args.eit is None or args.stage is not None:
            raise ValueError(f"{args.calibration}: the calibration of a skin; give --eit and --pressure, no --stage")
        return plan_recording({"eit": args.eit, "pressure": args.pressure}, calibration.skin)
    if args.eit is not None or (args.stage is None) == calibration.needs_place:
        need = "--pressure and --stage" if calibration.needs_place else "--pressure"
        raise ValueError(f"{args.calibration}: the calibration of a log; give {need} and no other stream")
    urls = {"pressure": args.pressure} | ({"stage": args.stage} if calibration.needs_place else {})
    return plan_recording(urls, None, channels={"pressure": calibration.columns})


def _set_up_process(args: argparse.Namespace) -> None:
    """Refuse at once what this machine cannot do, and set up numerical libraries for single frames."""
    from ....record.priority import real_time

    with real_time(args.realtime):
        pass
    if args.rerun is not None:
        _require_rerun()
    from ....runtime import set_up_live

    set_up_live()


def _require_rerun() -> None:
    from importlib.util import find_spec

    if find_spec("rerun") is None:
        raise ImportError("--rerun needs rerun: pip install 'jaxeit[viewer]'")
