"""The `jaxeit` command.  Heavy imports are inside the commands, so that --help is quick."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

_CURVE_NAMES = ("linear", "affine", "power", "polynomial", "spline", "play", "hysteresis", "hysteresis-spline", "auto")
_LOCATION_NAMES = ("none", "constant", "bilinear", "rbf", "edge", "edge-size", "spline", "gp", "auto")
_STREAMS = ("eit", "pressure", "force", "stage", "temperature", "barometer")


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
    parser.add_argument("scene", metavar="SCENE.toml", help="a scene file, or a shipped scene by its name")
    parser.add_argument("-o", "--output", metavar="SESSION.h5")
    text = "print what the scene simulates and what each part costs, and simulate nothing"
    parser.add_argument("--explain", action="store_true", help=text)
    text = "then play SESSION.h5, simulated only if it is not there, as the skin would send it, at local TCP ports"
    parser.add_argument("--serve", action="store_true", help=text)
    text = "SCENE is a skin: Gaussian contacts on a grid over it, from 0 to 100 %%, as one data set (HDF5)"
    parser.add_argument("--data-set", nargs="?", type=int, const=41, metavar="N", help=f"{text}; N x N places, 41")


def _simulate(args: argparse.Namespace) -> int:
    if bool(args.output) == args.explain:
        raise ValueError("give either -o SESSION.h5 to simulate, or --explain")
    from .runtime import set_up

    set_up()
    from .bench import explain, load_bench, render, simulate

    if args.data_set:
        return _simulate_data_set(args)
    bench = load_bench(args.scene)
    if args.explain:
        print(render(bench, explain(bench)))
        return 0
    _outputs(args.output)
    if args.serve and Path(args.output).exists():
        return _serve(args.output)
    try:
        simulate(bench, args.output, progress=_progress("blocks"))
    except KeyboardInterrupt:
        print(f"jaxeit: interrupted; the same command goes on from {args.output}.part", file=sys.stderr)
        return 130
    print(f"{args.output}: {len(bench.sites)} presses, {bench.duration:.0f} s, SIMULATED")
    return _serve(args.output) if args.serve else 0


def _serve(path: str) -> int:
    """Be a device until interrupted."""
    import threading

    from .acquisition.device import Device, recording
    from .session import open_session

    with open_session(path) as session:
        names = [name for name in ("eit", "pressure", "force") if name in session.streams]
    with Device([recording(path, [name], rounds=10**6) for name in names]) as device:
        where = " ".join(f"--{name} {url}" for name, url in zip(names, device.urls, strict=True))
        with suppress(KeyboardInterrupt):
            print(f"serving {path}, SIMULATED; in another terminal: jaxeit record {where} -o session.h5", flush=True)
            threading.Event().wait()
    return 0


def _simulate_data_set(args: argparse.Namespace) -> int:
    from .bench import write_data_set

    if args.explain or args.serve:
        raise ValueError("--explain and --serve are for scenes; leave them out")
    _outputs(args.output)
    skin, progress = _skin(args.scene), _progress("contacts")
    places, steps = write_data_set(skin, args.output, columns=args.data_set, rows=args.data_set, progress=progress)
    print(f"{args.output}: {places} places, {steps} amplitudes, SIMULATED")
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

    return run(args, _skin(args.skin))


# --- calibrate -----------------------------------------------------------------------------------


def _calibrate_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    text = "one calibration of all sessions together; with --jobs or --scheduler the folder for one of each"
    parser.add_argument("-o", "--output", required=True, metavar="CALIBRATION.h5", help=text)
    text = "write a page with figures; with --jobs or --scheduler without a name, one beside each calibration"
    parser.add_argument("--report", nargs="?", const="", metavar="REPORT.html", help=text)
    text = "sessions the fit does not see, to judge it on"
    parser.add_argument("--test", nargs="+", default=[], metavar="SESSION.h5", help=text)
    text = "force from pressure; auto: chosen by cross-validation over locations; default: linear"
    parser.add_argument("--curve", choices=_CURVE_NAMES, default="linear", help=text)
    text = "correct for where a pad is pressed, as the image tells; default: none (the paper's recipe)"
    parser.add_argument("--location", choices=_LOCATION_NAMES, default="none", help=text)
    parser.add_argument("--skin", help="a shipped skin or a TOML file; default: the session's own")
    _low_pass_arg(parser)
    parser.add_argument("--hyperparameter", type=float, default=0.1, help="default: 0.1")
    parser.add_argument("--pixels", type=int, default=40, help="along x; default: 40")
    text = "parts into which the places are divided, each predicted from the others; from the number of places on, "
    parser.add_argument("--folds", type=_count, default=5, metavar="K", help=text + "one place at a time; default: 5")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    many = parser.add_mutually_exclusive_group()
    text = "calibrate every session by itself, N at a time; those that are done in the output folder are skipped"
    many.add_argument("--jobs", type=_count, metavar="N", help=text)
    text = "the same by the workers of a Dask scheduler, which must see the same files"
    many.add_argument("--scheduler", metavar="ADDRESS", help=text)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: give a whole number above zero")
    return int(text)


def _low_pass_arg(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--low-pass", type=float, metavar="HZ", help="cut-off; default: 50 if it fits")


def _title(names: str, simulated: bool) -> str:
    return ("SIMULATED, " if simulated else "") + names


def _processing(low_pass: float | None):
    from .corrections import LowPass
    from .measured import Processing

    return Processing() if low_pass is None else Processing(corrections=(LowPass(low_pass),))


def _curves(name: str, *, logs: bool = False):
    """The curve of a name, or all candidates for auto: on pads only those that are zero at zero and forget."""
    from .curves import CURVES

    if name != "auto":
        return CURVES[name]()
    return [CURVES[n]() for n in (CURVES if logs else ("linear", "power", "polynomial", "spline"))]


def _locations(name: str):
    from .location import default_field

    if name == "auto":
        return [None, *map(default_field, _LOCATION_NAMES[2:-1])]
    return None if name == "none" else default_field(name)


def _calibrate(args: argparse.Namespace) -> int:
    from .runtime import set_up

    set_up()
    if args.report is not None:
        _require_matplotlib("--report")
    if args.jobs or args.scheduler:
        return _calibrate_many(args)
    if args.report == "":
        raise ValueError("--report: give the name of the page, as --report report.html")
    return _calibrate_together(args)


def _choices(args: argparse.Namespace) -> dict:
    """What a calibration is told, beside its sessions."""
    import jaxeit as je

    return {
        "skin": _skin(args.skin),
        "curve": _curves(args.curve),
        "location": _locations(args.location),
        "basis": je.Pixels(args.pixels),
        "hyperparameter": args.hyperparameter,
        "folds": args.folds,
        "processing": _processing(args.low_pass),
    }


def _calibrate_together(args: argparse.Namespace) -> int:
    from .calibration import STAGES, calibrate, evaluate
    from .evaluation import render_table
    from .session import open_session

    _outputs(args.output, args.report)
    choices = _choices(args)
    with ExitStack() as stack:
        sessions = [stack.enter_context(open_session(path)) for path in args.sessions]
        if all("eit" not in session.streams for session in sessions):
            return _calibrate_logs(args, sessions)
        stages = stack.enter_context(_stages(len(STAGES)))
        calibration = calibrate(sessions, **choices, progress=stages)
        tests = {Path(path).name: stack.enter_context(open_session(path)) for path in args.test}
        tried = {name: evaluate(calibration, session, choices["processing"]) for name, session in tests.items()}
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


def _calibrate_many(args: argparse.Namespace) -> int:
    """Each session by itself; status 2 if one failed, when all others are done."""
    from tqdm import tqdm

    from .batch import calibrate_many, render_outcomes
    from .cluster import dask_executor

    if args.test:
        raise ValueError("--test is for one calibration; try those of a folder with jaxeit evaluate")
    if args.report:
        raise ValueError(f"--report {args.report}: every session gets a page of its own; give --report without a name")
    with ExitStack() as stack:
        executor = stack.enter_context(dask_executor(args.scheduler)) if args.scheduler else None
        bar = stack.enter_context(tqdm(total=len(args.sessions), desc="sessions", disable=None, leave=False))

        def tell(outcome) -> None:
            bar.update()
            if outcome.reason:
                tqdm.write(f"jaxeit: {Path(outcome.session).name}: {outcome.reason}", file=sys.stderr)

        outcomes = calibrate_many(
            args.sessions,
            args.output,
            executor=executor,
            jobs=args.jobs,
            report=args.report is not None,
            tell=tell,
            **_choices(args),
        )
    if args.json:
        print(json.dumps({o.session: o.summary or {"failed": o.reason} for o in outcomes}, indent=2, sort_keys=True))
    else:
        print(render_outcomes(outcomes, args.output))
    return 2 if any(outcome.reason for outcome in outcomes) else 0


def _calibrate_logs(args: argparse.Namespace, sessions) -> int:
    """Sessions without EIT: one curve per log, tested on its second half."""
    from .logs import fit_session, render_log, save_logs

    if args.report or args.test or args.skin or args.location != "none":
        raise ValueError(
            "--report, --test, --skin and --location need sessions with EIT; these hold none: leave them out"
        )
    fits = {session.name: fit_session(session, _curves(args.curve, logs=True)) for session in sessions}
    save_logs(fits, args.output)
    print("\n".join(render_log(name, fit) for name, fit in fits.items()))
    print(f"\nwrote {args.output}")
    return 0


def _require_matplotlib(option: str) -> None:
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        raise ImportError(f"{option} needs matplotlib: pip install 'jaxeit[report]'")


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


# --- record and recover --------------------------------------------------------------------------


def _record_args(parser: argparse.ArgumentParser) -> None:
    text = "where the stream comes from: tcp://HOST:PORT, serial:///dev/ttyACM0?baud=115200, replay://SESSION.h5; "
    text += "options after ? are format=csv, rate=, tick=, scale=, offset=, id=, channels= (docs/wire-format.md)"
    streams = parser.add_argument_group("streams", text)
    for name in _STREAMS:
        also = ["--load-cell"] if name == "force" else []
        streams.add_argument(f"--{name}", *also, dest=name, metavar="URL")
    parser.add_argument("--skin", help="a shipped skin or a TOML file; says the order of the readings")
    parser.add_argument("-o", "--output", required=True, metavar="SESSION.h5")
    parser.add_argument("--seconds", type=_above_zero, help="how long; default: until Ctrl-C")
    parser.add_argument("--title", default="", help="a line to know the session by")
    parser.add_argument("--wait", type=_above_zero, default=10.0, metavar="S", help="for devices to begin; default: 10")


def _above_zero(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: give a number above zero")
    return value


def _record(args: argparse.Namespace) -> int:
    from .acquisition.recorder import Orders, part_of, record
    from .acquisition.setup import prepare

    urls = {name: getattr(args, name) for name in _STREAMS if getattr(args, name) is not None}
    if not urls:
        raise ValueError(f"which streams? give at least one of {', '.join('--' + n for n in _STREAMS)}")
    _outputs(args.output)
    plan, sources = prepare(urls, _skin(args.skin), args.title)
    orders = Orders()
    try:
        with _signals(orders, planned=args.seconds is not None), _status_line() as progress:
            summary = record(
                plan, sources, args.output, seconds=args.seconds, wait=args.wait, orders=orders, progress=progress
            )
    except KeyboardInterrupt:
        print(f"jaxeit: interrupted; the recording is kept: jaxeit recover {part_of(args.output)}", file=sys.stderr)
        return 130
    print(summary.render())
    return orders.status


@contextmanager
def _signals(orders, planned: bool) -> Iterator[None]:
    """The first signal ends a recording in order, a second one at once; Ctrl-C is how one without end is ended."""
    import signal

    def tell(number: int, _frame) -> None:
        if orders.stop.is_set():
            raise KeyboardInterrupt
        expected = number == signal.SIGINT and not planned
        orders.give("" if expected else f"stopped by {signal.Signals(number).name}", 0 if expected else 128 + number)

    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]  # as nohup has it
    before = {number: signal.signal(number, tell) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _status_line() -> Iterator[Callable[[str], None]]:
    """A line on the terminal that is written over; nothing where nobody watches."""
    if not sys.stderr.isatty():
        yield lambda line: None
        return
    try:
        yield lambda line: print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def _recover_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("journal", metavar="SESSION.h5.part")
    parser.add_argument("-o", "--output", metavar="SESSION.h5", help="default: the name without .part")


def _recover(args: argparse.Namespace) -> int:
    from .acquisition.finish import finish

    output = args.output or args.journal.removesuffix(".part")
    if output == args.journal:
        raise ValueError(f"{args.journal}: does not end in .part; say with -o how the session is to be called")
    if os.path.exists(output):
        raise ValueError(f"{output}: exists already; give another name with -o, or remove it")
    _outputs(output)
    with _bytes(2 * _size(args.journal), "recovering") as progress:
        summary = finish(args.journal, output, recovered=True, progress=progress)
    print(summary.render())
    print(f"look at it (jaxeit check {output}); {args.journal} may then be deleted")
    return 0


def _live_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--calibration", required=True, metavar="CALIBRATION.h5")
    parser.add_argument("--eit", required=True, metavar="URL", help="as for jaxeit record")
    parser.add_argument("--pressure", required=True, metavar="URL")
    parser.add_argument("--rest", type=_above_zero, default=2.0, metavar="S", help="untouched at first; default: 2")
    parser.add_argument("--wait", type=_above_zero, default=10.0, metavar="S", help="for devices to begin; default: 10")
    parser.add_argument("--seconds", type=_above_zero, help="how long; default: until Ctrl-C")
    parser.add_argument("--host", default="127.0.0.1", help="to listen on; default: this machine only")
    parser.add_argument("--port", type=int, default=8765, help="of the page; 0: any; default: 8765")
    parser.add_argument("--publish", type=int, metavar="PORT", help="send results there as lines of JSON; 0: any")
    parser.add_argument("--json", action="store_true", help="print results as lines of JSON")
    text = "show results in a rerun viewer that runs there (default: 127.0.0.1:9876), or write them to FILE.rrd"
    parser.add_argument("--rerun", nargs="?", const="127.0.0.1:9876", metavar="HOST:PORT|FILE.rrd", help=text)
    parser.add_argument("-o", "--output", metavar="SESSION.h5", help="record what arrives as well")
    text = "tell the device what to read next: few readings at rest, those around a contact while there is one"
    parser.add_argument("--event-driven", action="store_true", help=text)
    text = "go before all ordinary processes: frames are worked on at once on a busy machine too (Linux, if allowed)"
    parser.add_argument("--realtime", action="store_true", help=text)


_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


def _live(args: argparse.Namespace) -> int:
    from .acquisition.priority import real_time

    with real_time(args.realtime):
        pass  # refused at once or not at all
    for name in _BLAS_THREADS:  # a small product waits for its slowest thread, on a busy machine for long
        os.environ.setdefault(name, "1")
    if args.rerun is not None:
        _require_rerun()
    from .runtime import set_up_live

    set_up_live()
    from threading import Timer

    from .acquisition.live import Show
    from .acquisition.present import present
    from .acquisition.recorder import Orders
    from .acquisition.setup import prepare
    from .calibration import load_calibration

    _outputs(args.output)
    calibration = load_calibration(args.calibration)
    plan, sources = prepare({"eit": args.eit, "pressure": args.pressure}, calibration.skin)
    orders = Orders()
    show = Show(stop=orders.stop)
    also: list[Callable] = [lambda result: print(result.to_json(), flush=True)] if args.json else []
    timer = Timer(args.seconds or 0.0, orders.give)
    timer.daemon = True
    with _signals(orders, planned=False), ExitStack() as stack:
        if args.rerun is not None:
            from .acquisition.rerun_view import RerunView

            also.append(stack.enter_context(RerunView(calibration, show, args.rerun)).show_result)
        if args.seconds is not None:
            timer.start()
        count = present(
            calibration,
            plan,
            sources,
            show,
            host=args.host,
            port=args.port,
            publish=args.publish,
            also=also,
            output=args.output,
            event_driven=args.event_driven,
            realtime=args.realtime,
            tell=lambda line: print(f"jaxeit: {line}", file=sys.stderr),
            rest=args.rest,
            wait=args.wait,
        )
        timer.cancel()
    print(f"jaxeit: {count} frames", file=sys.stderr)
    return orders.status


def _require_rerun() -> None:
    from importlib.util import find_spec

    if find_spec("rerun") is None:
        raise ImportError("--rerun needs rerun: pip install 'jaxeit[viewer]'")


def _doctor_args(parser: argparse.ArgumentParser) -> None:
    pass


def _doctor(args: argparse.Namespace) -> int:
    from .acquisition.doctor import examine

    lines = examine()
    print("\n".join(line.render() for line in lines))
    return 0 if all(line.ok for line in lines) else 2


# --- bench ---------------------------------------------------------------------------------------


def _bench_args(parser: argparse.ArgumentParser) -> None:
    text = "a shipped skin or scene by its name, or the TOML file of your own; default: testbed"
    parser.add_argument("what", nargs="?", default="testbed", metavar="SKIN|SCENE.toml", help=text)
    text = "recommend the most accurate rung that solves in this time"
    parser.add_argument("--budget-ms", type=_above_zero, metavar="MS", help=text)
    text = "recommend the quickest rung whose error of a touch is no more than this, such as 2e-3"
    parser.add_argument("--error", type=_above_zero, metavar="E", help=text)
    parser.add_argument("--smoke", action="store_true", help="a few coarse rungs, within a minute")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.add_argument("-o", "--output", metavar="FIGURE.png", help="draw error against time")


def _bench(args: argparse.Namespace) -> int:
    from shutil import get_terminal_size

    import jax

    import jaxeit as je

    _outputs(args.output)
    if args.output:
        _require_matplotlib("-o")
    scene = _bench_scene(args.what)
    rungs, budget = (je.few_choices(), 0.1) if args.smoke else (None, 0.5)
    with jax.enable_x64(True):  # and no cache of programs: how long they take to compile is measured
        found = je.ladder(scene, rungs, budget=budget, progress=_progress("rungs"))
    if args.output:
        _write_ladder_figure(found, Path(args.output))
    wishes = {"budget_ms": args.budget_ms, "error": args.error}
    wanted = any(wish is not None for wish in wishes.values())
    if not args.json:
        print(found.table(get_terminal_size((110, 24)).columns), flush=True)
        if wanted:
            print("\n" + found.advice(**wishes))
        return 0
    report = found.summary()
    try:
        if wanted:
            report["recommended"] = found.recommend(**wishes).choice.label
    finally:  # what was measured is told even where no rung is good enough
        print(json.dumps(report, indent=2))
    return 0


def _bench_scene(what: str):
    """A scene by name or file; of a skin, the ideal sensor."""
    import re

    import jaxeit as je

    from .bench import load_bench, presets

    path = Path(what)
    if what in je.shipped_skins():
        return je.Scene(je.load_skin(what))
    if not path.exists() and what not in presets():
        known = ", ".join((*je.shipped_skins(), *presets()))
        raise ValueError(f"{what}: no such file, skin or scene; shipped are {known}")
    if path.is_file() and re.search(r'^format\s*=\s*"jaxeit-skin"', je.read_text(path), re.MULTILINE):
        return je.Scene(je.load_skin(path))
    return load_bench(what).scene


def _write_ladder_figure(found, path: Path) -> None:
    from .figures import write_figure
    from .ladder_figure import ladder_figure

    write_figure(ladder_figure([found.summary()]), path)


def _size(path: str) -> int:
    return os.path.getsize(path) if os.path.isfile(path) else 0


@contextmanager
def _bytes(total: int, text: str) -> Iterator[Callable[[int], object]]:
    from tqdm import tqdm

    with tqdm(total=total, desc=text, unit="B", unit_scale=True, disable=None, leave=False) as bar:
        yield bar.update


_COMMANDS: dict[str, tuple[Callable, Callable, str]] = {
    "simulate": (_simulate, _simulate_args, "simulate a bench session from a scene file"),
    "check": (_check, _check_args, "validate a recording; say what is wrong and where"),
    "import": (_import, _import_args, "bring foreign recordings into a session file"),
    "calibrate": (_calibrate, _calibrate_args, "fit a calibration to recorded sessions"),
    "evaluate": (_evaluate, _evaluate_args, "judge a calibration on other sessions"),
    "apply": (_apply, _apply_args, "write the force map of every frame of a session"),
    "bench": (_bench, _bench_args, "measure what accuracy costs in time, for a skin on this machine"),
    "record": (_record, _record_args, "record devices into a session file; nothing that arrived is lost"),
    "live": (_live, _live_args, "show the force map as frames arrive, on a page of its own"),
    "doctor": (_doctor, _doctor_args, "examine this machine: versions, device, threads, cache, disk, ports"),
    "recover": (_recover, _recover_args, "make a session of what a crash left of a recording"),
}


if __name__ == "__main__":
    sys.exit(main())
