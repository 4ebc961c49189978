"""The `jaxeit` command. Each subcommand is a separate module, imported when it is called, so that --help is quick."""

import argparse
import gc
import os
import select
import signal
import sys
from collections.abc import Collection, Sequence
from importlib import import_module
from typing import Any

from .parser import CommandParser
from .signals import termination_raised
from .terminal import one_line, say, say_interrupted

COMMANDS = {
    "simulate": "simulate a bench session from a scene file",
    "check": "validate a recording; say what is wrong and where",
    "import": "convert recordings in other formats to a session file",
    "calibrate": "fit a calibration to recorded sessions",
    "recalibrate": "move a calibration to what the pads read now: offsets, gains and drift",
    "evaluate": "evaluate a calibration on other sessions",
    "apply": "write the force map of every frame of a session",
    "image": "draw the difference image of a tank: files of EIDORS, PyEIDORS, instruments (.get, .eit), NumPy",
    "export": "write for other programs: a C header for firmware, CSV, ROS 2 (MCAP), LeRobot, Parquet",
    "bench": "measure what accuracy costs in time, for a skin on this machine",
    "design": "choose which readings a skin should take, out of all that its electrodes allow",
    "train": "train a network that proposes what touches a skin, on scenes drawn at random",
    "record": "record devices into a session file; nothing that arrived is lost",
    "live": "show force maps on a web page as frames arrive",
    "doctor": "examine this machine: versions, device, threads, cache, disk, ports",
    "recover": "make a session from the journal that a crash left",
    "completion": "print a script that completes commands and options in a shell",
}
"""What each command does."""
ROOMS = {
    "recordings": ("simulate", "check", "import", "export", "record", "recover"),
    "calibrations": ("calibrate", "recalibrate", "evaluate", "apply", "live", "image"),
    "skins": ("bench", "design", "train", "doctor", "completion"),
}
"""Where each command is: ``commands/room/name_command.py``, with `add_arguments` and `run`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 on success, 2 for bad input with one line on standard error."""
    argv = sys.argv[1:] if argv is None else list(argv)
    _open_closed_streams()
    try:
        with termination_raised():
            return _run(argv)
    except (ValueError, OSError, ImportError) as error:
        if isinstance(error, BrokenPipeError) and _nobody_reads():
            return 128 + signal.SIGPIPE  # as a shell reports a program that the signal ended
        say(_with_remedy(error))
        return 2
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        say(f"{OUT_OF_MEMORY} ({one_line(error)[:200]})")
        return 2
    except KeyboardInterrupt as interrupt:
        return say_interrupted(interrupt, "; ".join(getattr(interrupt, "__notes__", ["nothing was written"])))


OUT_OF_MEMORY = "this machine has too little memory for it; use less data, a coarser fidelity or fewer pixels"


def _run(argv: list[str]) -> int:
    """Run one command, flush its output and return its exit status."""
    try:
        if not argv:
            _parser(argv).print_help(sys.stderr)
            return 2
        args, others = _parser(argv).parse_known_args(argv)
        if others:
            args.parser.refuse(others)
        status: int = args.command(args)
        return status
    finally:
        sys.stdout.flush()


def _open_closed_streams() -> None:
    """Give standard streams that are closed, as daemons start programs, the null device, in the order of their numbers.

    Otherwise nothing could be printed, and the first file that is opened would get the number of a standard stream.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def _with_remedy(error: Exception) -> str:
    """The message of an error; of a disk that is full also what to do, where the error does not name it."""
    if not isinstance(error, OSError) or error.filename is not None:
        return one_line(error)
    from ..session.outputs import FREE_SPACE, disk_full

    why = disk_full(error)
    return f"the output cannot be written ({why}); {FREE_SPACE}" if why else one_line(error)


def _nobody_reads() -> bool:
    """Whether standard output is a pipe that its reader has closed; the rest of its buffer is then discarded."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)  # a closed pipe is reported without being asked for
    if not any(events & (select.POLLERR | select.POLLHUP) for _, events in poll.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def is_out_of_memory(error: Exception) -> bool:
    """Whether an error of Python or JAX means that memory could not be allocated."""
    return isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error) or "Out of memory" in str(error)


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of all commands, with the arguments of the called command only, because each module costs imports."""
    return parser_with([word for word in argv if not word.startswith("-")][:1], argv)


def _imported(name: str) -> Any:
    """The module of a command. What is imported stays: the garbage collector would look through it again and again."""
    collects = gc.isenabled()
    gc.disable()
    try:
        return import_module(name, __name__)
    finally:
        gc.freeze()
        if collects:
            gc.enable()


def parser_with(loaded: Collection[str], argv: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser of all commands, with the arguments of those that are ``loaded``, for a command line ``argv``."""
    parser = CommandParser(prog="jaxeit", description="Force maps in newtons from EIT-pneumatic robot skins.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name in loaded:
            room = next(room for room, names in ROOMS.items() if name in names)
            module = _imported(f".commands.{room}.{name}_command")
            command.set_defaults(command=module.run, parser=command)
            command.words = argv
            module.add_arguments(command)
    return parser


class _Version(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        from importlib import metadata

        print(f"jaxeit {metadata.version('jaxeit')}")
        parser.exit()
