"""The `jaxeit` command.  Heavy imports are inside the commands, so that --help is quick."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

_CURVE_NAMES = ("linear", "affine", "power")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 on success, 2 for bad input with one line on standard error."""
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        args = _parser(argv).parse_args(argv)
        return args.command(args)
    except (ValueError, OSError, ImportError) as error:
        print(f"jaxeit: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxeit: interrupted; nothing was written", file=sys.stderr)
        return 130


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """All commands by name; the arguments only of the one that is called, as some cost imports."""
    chosen = next((word for word in argv if not word.startswith("-")), None)
    parser = argparse.ArgumentParser(
        prog="jaxeit",
        description="Force maps in newtons from EIT-pneumatic robot skins.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, (run, arguments, text) in _COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        command.set_defaults(command=run)
        if name == chosen:
            arguments(command)
    return parser


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        from importlib import metadata

        parser.exit(message=f"jaxeit {metadata.version('jaxeit')}\n")


def _progress(text: str) -> Callable:
    from tqdm import tqdm

    return partial(tqdm, desc=text, disable=None, leave=False)  # silent where nobody watches


@contextmanager
def _stages(count: int) -> Iterator[Callable[[str], None]]:
    """A bar that is told the name of each stage as it begins."""
    from tqdm import tqdm

    with tqdm(total=count, disable=None, leave=False) as bar:

        def begin(stage: str) -> None:
            bar.set_description(stage)
            bar.update()

        yield begin


# --- simulate ------------------------------------------------------------------------------------


def _simulate_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE.toml")
    parser.add_argument("-o", "--output", required=True, metavar="SESSION.h5")


def _simulate(args: argparse.Namespace) -> int:
    from .runtime import set_up

    set_up()
    from .bench import load_bench, simulate

    _outputs(args.output)
    bench = load_bench(args.scene)
    simulate(bench, args.output, progress=_progress("presses"))
    print(f"{args.output}: {len(bench.sites)} presses, {bench.duration:.0f} s, SIMULATED")
    return 0


# --- check ---------------------------------------------------------------------------------------


def _check_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    parser.add_argument("--skin", help="a shipped skin or a TOML file; default: the session's own")
    parser.add_argument("--all", action="store_true", help="print every channel")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def _check(args: argparse.Namespace) -> int:
    from .runtime import set_up

    set_up()
    from .check import check_session, render, to_json
    from .session import SessionError, open_session

    skin, worst = _skin(args.skin), 0
    for path in args.sessions:
        try:
            with open_session(path) as session:
                report = check_session(session, skin, progress=_progress(session.name))
        except SessionError as error:
            print(f"jaxeit: {_one_line(error)}", file=sys.stderr)
            worst = 2
            continue
        print(to_json(report) if args.json else render(report, verbose=args.all))
        worst = worst if report.ok else 2
    return worst


def _skin(name: str | None):
    if name is None:
        return None
    import jaxeit as je

    return je.load_skin(name)


# --- import --------------------------------------------------------------------------------------


def _import_args(parser: argparse.ArgumentParser) -> None:
    from .importers import add_arguments

    add_arguments(parser)


def _import(args: argparse.Namespace) -> int:
    from .importers import run

    return run(args)


# --- calibrate -----------------------------------------------------------------------------------


def _calibrate_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    parser.add_argument("-o", "--output", required=True, metavar="CALIBRATION.h5")
    parser.add_argument("--report", metavar="REPORT.html", help="write a page with figures")
    text = "sessions the fit does not see, to judge it on"
    parser.add_argument("--test", nargs="+", default=[], metavar="SESSION.h5", help=text)
    parser.add_argument("--curve", choices=_CURVE_NAMES, default="linear", help="default: linear")
    parser.add_argument("--skin", help="a shipped skin or a TOML file; default: the session's own")
    _low_pass_arg(parser)
    parser.add_argument("--hyperparameter", type=float, default=0.1, help="default: 0.1")
    parser.add_argument("--pixels", type=int, default=40, help="along x; default: 40")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def _low_pass_arg(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--low-pass", type=float, metavar="HZ", help="cut-off; default: 50 if it fits")


def _title(names: str, simulated: bool) -> str:
    return ("SIMULATED, " if simulated else "") + names


def _processing(low_pass: float | None):
    from .corrections import LowPass
    from .measured import Processing

    return Processing() if low_pass is None else Processing(corrections=(LowPass(low_pass),))


def _calibrate(args: argparse.Namespace) -> int:
    from .runtime import set_up

    set_up()
    import jaxeit as je

    from .calibration import STAGES, calibrate, evaluate
    from .curves import CURVES
    from .evaluation import render_table
    from .session import open_session

    _outputs(args.output, args.report)
    processing = _processing(args.low_pass)
    if args.report:
        _require_report()
    with ExitStack() as stack:
        sessions = [stack.enter_context(open_session(path)) for path in args.sessions]
        if all("eit" not in session.streams for session in sessions):
            return _calibrate_logs(args, sessions)
        stages = stack.enter_context(_stages(len(STAGES)))
        calibration = calibrate(
            sessions,
            _skin(args.skin),
            curve=CURVES[args.curve](),
            basis=je.Pixels(args.pixels),
            hyperparameter=args.hyperparameter,
            processing=processing,
            progress=stages,
        )
        tests = {Path(path).name: stack.enter_context(open_session(path)) for path in args.test}
        tried = {name: evaluate(calibration, session, processing) for name, session in tests.items()}
    calibration.save(args.output)
    if args.report:
        from .report import write_report

        write_report(calibration, Path(args.report), evaluations=tried)
    if args.json:
        results = {"calibration": calibration.evaluation.summary()} | {n: e.summary() for n, e in tried.items()}
        print(json.dumps(results, indent=2, sort_keys=True))
        return 0
    names = ", ".join(Path(path).name for path in args.sessions)
    print(render_table(calibration.evaluation, _title(names, calibration.simulated)))
    for note in calibration.notes:
        print(f"  note: {note}")
    for name, found in tried.items():
        print("\n" + render_table(found, _title(name, tests[name].simulated)))
    print(f"\nwrote {args.output}" + (f" and {args.report}" if args.report else ""))
    return 0


def _calibrate_logs(args: argparse.Namespace, sessions) -> int:
    """Sessions without EIT: one curve per log, tested on its second half."""
    from .curves import CURVES
    from .logs import fit_session, render_log, save_logs

    if args.report or args.test or args.skin:
        raise ValueError("--report, --test and --skin need sessions with EIT; these hold none: leave them out")
    fits = {session.name: fit_session(session, CURVES[args.curve]()) for session in sessions}
    save_logs(fits, args.output)
    print("\n".join(render_log(name, fit) for name, fit in fits.items()))
    print(f"\nwrote {args.output}")
    return 0


def _require_report() -> None:
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        raise ImportError("--report needs matplotlib: pip install 'jaxeit[report]'")


def _outputs(*paths: str | None) -> None:
    """Make the folders of what will be written, and say before the work begins if that cannot be."""
    for path in map(Path, filter(None, paths)):
        if path.is_dir():
            raise ValueError(f"{path}: is a folder; give a file name")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise ValueError(f"{path}: the folder cannot be written to; choose another")


# --- evaluate ------------------------------------------------------------------------------------


def _evaluate_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("calibration", metavar="CALIBRATION.h5")
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    _low_pass_arg(parser)
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def _evaluate(args: argparse.Namespace) -> int:
    from .runtime import set_up

    set_up()
    from .calibration import evaluate, load_calibration
    from .evaluation import render_table
    from .session import open_session

    calibration = load_calibration(args.calibration)
    results = {}
    for path in _progress("sessions")(args.sessions):
        with open_session(path) as session:
            found = evaluate(calibration, session, _processing(args.low_pass))
            title = _title(session.name, session.simulated)
        results[Path(path).name] = found.summary()
        if not args.json:
            print(render_table(found, title))
    if args.json:
        print(json.dumps(results, indent=2, sort_keys=True))
    return 0


# --- apply ---------------------------------------------------------------------------------------


def _apply_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("calibration", metavar="CALIBRATION.h5")
    parser.add_argument("session", metavar="SESSION.h5")
    parser.add_argument("-o", "--output", required=True, metavar="FORCEMAP.h5")
    _low_pass_arg(parser)


def _apply(args: argparse.Namespace) -> int:
    from .runtime import set_up

    set_up()
    from .calibration import load_calibration
    from .maps import apply
    from .session import open_session

    _outputs(args.output)
    calibration = load_calibration(args.calibration)
    with open_session(args.session) as session:
        apply(
            calibration,
            session,
            args.output,
            processing=_processing(args.low_pass),
            progress=_progress("frames"),
        )
        frames = len(session.stream("eit"))
    print(f"{args.output}: {frames} force maps in newtons")
    return 0


_COMMANDS: dict[str, tuple[Callable, Callable, str]] = {
    "simulate": (_simulate, _simulate_args, "simulate a bench session from a scene file"),
    "check": (_check, _check_args, "validate a recording; say what is wrong and where"),
    "import": (_import, _import_args, "bring foreign recordings into a session file"),
    "calibrate": (_calibrate, _calibrate_args, "fit a calibration to recorded sessions"),
    "evaluate": (_evaluate, _evaluate_args, "judge a calibration on other sessions"),
    "apply": (_apply, _apply_args, "write the force map of every frame of a session"),
}


if __name__ == "__main__":
    sys.exit(main())
