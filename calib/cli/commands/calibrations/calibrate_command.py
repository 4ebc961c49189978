"""`jaxeit calibrate`."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ....calibration import Recipe
from ....calibration.recipes.text import NONE, SWITCHES
from ....session import Session
from ...arguments import count, prepare_results, require_matplotlib_for, skin_of
from ...recipe_options import IMAGING, add_recipe_arguments, recipe_of
from ...results import render_calibration, render_found
from ...terminal import after_writing, announce_model, say_interrupted, show, stage_bar, title

if TYPE_CHECKING:
    from jaxeit.skin import Skin


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Sessions, outputs, and every choice of a recipe."""
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    text = "one calibration from all sessions; with --jobs or --scheduler the folder of one calibration per session"
    parser.add_argument("-o", "--output", required=True, metavar="CALIBRATION.h5", help=text)
    text = "write an HTML report with figures; with --jobs or --scheduler give no name: one report per calibration"
    parser.add_argument("--report", nargs="?", const="", metavar="REPORT.html", help=text)
    text = "sessions that are left out of the fit, for evaluation"
    parser.add_argument("--test", nargs="+", default=[], metavar="SESSION.h5", help=text)
    parser.add_argument("--skin", help="a shipped skin or a TOML file; default: the session's own")
    text = "continue despite errors that `jaxeit check` finds; the results name them"
    parser.add_argument("--force", action="store_true", help=text)
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    many = parser.add_mutually_exclusive_group()
    text = "calibrate each session separately, N at a time; sessions already done in the output folder are skipped"
    many.add_argument("--jobs", type=count, metavar="N", help=text)
    text = "as --jobs, on the workers of a Dask scheduler, which must see the same files"
    many.add_argument("--scheduler", metavar="ADDRESS", help=text)
    add_recipe_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate from all sessions together, or from each session separately."""
    from ....runtime import set_up

    set_up()
    if args.report is not None:
        require_matplotlib_for("--report")
    if args.jobs or args.scheduler:
        return _calibrate_many(args)
    if args.report == "":
        raise ValueError("--report: give the name of the page, as --report report.html")
    return _calibrate_together(args)


def _calibrate_together(args: argparse.Namespace) -> int:
    from ....calibration.argument_checks import are_logs
    from ....calibration.procedure import calibrate, evaluate
    from ....session import open_session

    prepare_results(args, "output", "report")
    recipe, skin = recipe_of(args), skin_of(args.skin)
    with ExitStack() as stack:
        sessions = [stack.enter_context(open_session(path)) for path in args.sessions]
        if are_logs(sessions, "calibrate"):
            _refuse_eit_options(args)
            stages = stack.enter_context(stage_bar(1))
        else:
            stages = stack.enter_context(_skin_stages(sessions, skin, recipe))
        calibration = calibrate(sessions, skin, recipe=recipe, ignore_errors=args.force, progress=stages)
        tests = {Path(path).name: stack.enter_context(open_session(path)) for path in args.test}
        tried: dict[str, Any] = {name: evaluate(calibration, s, ignore_errors=args.force) for name, s in tests.items()}
    calibration.save(args.output)
    if args.report:
        from ....report.document import write_report

        with after_writing(args.output):
            write_report(calibration, Path(args.report), evaluations=tried)
    if args.json:
        own = calibration.evaluation.summary() | {"notes": list(calibration.notes)}
        results = {"calibration": own} | {name: found.summary() for name, found in tried.items()}
        print(json.dumps(results, indent=2, sort_keys=True))
        return 0
    show(render_calibration(calibration, title(_names(args), calibration.simulated)))
    for name, found in tried.items():
        show("\n" + render_found(found, title(name, tests[name].simulated)))
    show(f"\nwrote {args.output}" + (f" and {args.report}" if args.report else ""))
    return 0


def _skin_stages(
    sessions: Sequence[Session], skin: "Skin | None", recipe: Recipe
) -> AbstractContextManager[Callable[[str], None]]:
    """The progress bar of a calibration of a skin, whose model is announced."""
    from jaxeit.skin import parse_skin

    from ....calibration.procedure import STAGES

    announce_model(skin or parse_skin(sessions[0].skin_toml, f"{sessions[0].name}: skin_toml"), recipe.fidelity)
    return stage_bar(len(STAGES) + recipe.fit_electrodes + recipe.learn_layer)


_NEED_EIT = ("skin", "locator", "folds", "fidelity", "baseline", "correction", "low_pass", *SWITCHES, *IMAGING)


def _refuse_eit_options(args: argparse.Namespace) -> None:
    """Refuse options about EIT for logs."""
    given = ["--" + name.replace("_", "-") for name in _NEED_EIT if getattr(args, name) not in (None, False, NONE)]
    if given:
        raise ValueError(f"{', '.join(given)}: for sessions with EIT, and these hold none; leave it out")


def _names(args: argparse.Namespace) -> str:
    return ", ".join(Path(path).name for path in args.sessions)


def _calibrate_many(args: argparse.Namespace) -> int:
    """Calibrate each session separately; status 2 if one failed, after all others are done."""
    from tqdm import tqdm

    from ....batch.cluster import dask_executor
    from ....batch.sessions import Outcome, calibrate_many, render_outcomes

    _refuse_single(args)
    with ExitStack() as stack:
        executor = stack.enter_context(dask_executor(args.scheduler)) if args.scheduler else None
        bar = stack.enter_context(tqdm(total=len(args.sessions), desc="sessions", disable=None, leave=False))

        written = set()

        def tell(outcome: Outcome) -> None:
            bar.update()
            if not outcome.reason:
                written.add(outcome.session)
            else:
                tqdm.write(f"jaxeit: {Path(outcome.session).name}: {outcome.reason}", file=sys.stderr)

        def finishing(running: int) -> None:
            sessions = f"{running} session{'s' * (running != 1)}"
            tqdm.write(f"jaxeit: finishing {sessions}; Ctrl-C again to stop now", file=sys.stderr)

        try:
            outcomes = calibrate_many(
                args.sessions,
                args.output,
                executor=executor,
                jobs=args.jobs,
                report=args.report is not None,
                tell=tell,
                finishing=finishing,
                recipe=recipe_of(args),
                skin=skin_of(args.skin),
                ignore_errors=args.force,
            )
        except KeyboardInterrupt as interrupt:
            total = len({os.path.abspath(path) for path in args.sessions})
            what = f"{len(written)} of {total} calibrations are in {args.output}; the same command goes on"
            return say_interrupted(interrupt, what)
    if args.json:
        print(json.dumps({o.session: o.summary or {"failed": o.reason} for o in outcomes}, indent=2, sort_keys=True))
    else:
        show(render_outcomes(outcomes, args.output))
    return 2 if any(outcome.reason for outcome in outcomes) else 0


def _refuse_single(args: argparse.Namespace) -> None:
    """Refuse what one calibration from all sessions takes, and a folder of calibrations does not."""
    if args.test:
        raise ValueError("--test is for one calibration; try those of a folder with jaxeit evaluate")
    if args.report:
        raise ValueError(f"--report {args.report}: every session gets a page of its own; give --report without a name")
