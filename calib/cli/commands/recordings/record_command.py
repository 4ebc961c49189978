"""`jaxeit record`."""

import argparse

from ...arguments import above_zero, prepare_outputs, skin_of
from ...signals import orderly_end
from ...terminal import say, show, status_line

_STREAMS = ("eit", "pressure", "force", "stage", "temperature", "barometer")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A URL for each stream, and the file to write."""
    text = "where the stream comes from: tcp://HOST:PORT, serial:///dev/ttyACM0?baud=115200, replay://SESSION.h5; "
    text += "options after ? are format=csv, rate=, tick=, scale=, offset=, id=, channels= (docs/wire-format.md)"
    streams = parser.add_argument_group("streams", text)
    for name in _STREAMS:
        also = ["--load-cell"] if name == "force" else []
        streams.add_argument(f"--{name}", *also, dest=name, metavar="URL")
    parser.add_argument("--skin", help="a shipped skin or a TOML file; it defines the order of the readings")
    parser.add_argument("-o", "--output", required=True, metavar="SESSION.h5")
    parser.add_argument("--seconds", type=above_zero, help="duration; default: until Ctrl-C")
    parser.add_argument("--title", default="", help="title of the session, one line")
    text = "time within which every device must begin to send; default: 10"
    parser.add_argument("--wait", type=above_zero, default=10.0, metavar="S", help=text)


def run(args: argparse.Namespace) -> int:
    """Record until the time is over or the user stops the command."""
    from ....record.planning import plan_recording
    from ....record.recorder import StopRequest, journal_path, record_session

    urls = {name: getattr(args, name) for name in _STREAMS if getattr(args, name) is not None}
    if not urls:
        raise ValueError(f"which streams? give at least one of {', '.join('--' + n for n in _STREAMS)}")
    prepare_outputs(args, "output")
    plan, sources = plan_recording(urls, skin_of(args.skin), args.title)
    orders = StopRequest()
    try:
        with orderly_end(orders, planned=args.seconds is not None), status_line() as progress:
            summary = record_session(
                plan, sources, args.output, seconds=args.seconds, wait=args.wait, stop_request=orders, progress=progress
            )
    except KeyboardInterrupt:
        say(f"interrupted; the recording is kept: jaxeit recover {journal_path(args.output)}")
        return 130
    show(summary.render())
    return orders.status or (0 if summary.complete else 2)
