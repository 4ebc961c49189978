"""Calibrate each of many sessions, and write its report on request, by any `concurrent.futures.Executor`.

A session is done when its calibration lies in the output folder and names, by their hash, the session's bytes, the
recipe, the skin and the version it was made with. A batch that was killed therefore resumes where it stopped. Each
result appears whole or not at all, and is made by the process that holds the lock file beside it, so two batches into
one folder share the work.
"""

import contextlib
import os
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax

import jaxeit as je

from ..calibration.archives.opening import load_calibration
from ..calibration.argument_checks import are_logs
from ..calibration.calibration import Calibration
from ..calibration.logs.calibration import LogCalibration
from ..calibration.procedure import calibrate
from ..calibration.recipes.recipe import Recipe, recipe_or_default
from ..report.document import write_report
from ..report.figures.parts import require_matplotlib
from ..runtime import settings, take_over
from ..session import Session, SessionError, open_session
from ..session.argument_checks import paths_of, require_skin_or_none
from .digests import describe, digest
from .locks import exclusive, lock_of, remove_unfinished
from .workers import ONE_AT_A_TIME, end_workers, run_tasks, spawned_pool

_DIED = "its worker process died, most likely for want of memory; try it alone, or on a machine with more"
_SESSIONS_PER_WORKER = 16  # then a worker is replaced: each new skin leaves its compiled programs in memory


@dataclass(frozen=True)
class Outcome:
    """Result of one session.

    | meaning                                                              |
    |----------------------------------------------------------------------|
    | session, calibration: paths of the files                             |
    | reason: why the session failed, in one line; empty: it succeeded     |
    | skipped: whether the calibration existed already                     |
    | simulated: whether the session was simulated                         |
    | seconds: duration of the calibration, s                              |
    | summary: of the evaluation, or of a log's second half; empty: failed |
    """

    session: str
    calibration: str
    reason: str = ""
    skipped: bool = False
    simulated: bool = False
    seconds: float = 0.0
    summary: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _CalibrationTask:
    """A session, where its results go, and all that a worker needs to know.

    The choices (skin, recipe, whether errors are ignored) are pickled, so that a worker takes over the settings of JAX
    before it reads numbers of 64 bits; the mark is a digest of them.
    """

    session: str
    calibration: str
    report: bool
    choices: bytes
    mark: str
    settings: Mapping[str, Any]


def calibrate_many(
    paths: Iterable[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    recipe: Recipe | None = None,
    skin: je.Skin | None = None,
    ignore_errors: bool = False,
    executor: Executor | None = None,
    jobs: int | None = None,
    report: bool = False,
    tell: Callable[[Outcome], object] = lambda outcome: None,
    finishing: Callable[[int], object] = lambda running: None,
) -> tuple[Outcome, ...]:
    """Calibrate every session by itself: ``out/NAME.h5`` for ``NAME.h5``, in the order given.

    Args:
        paths: paths of the session files.
        out: output folder, created if necessary; sessions that are done there already are skipped.
        recipe, skin, ignore_errors: as for `calibrate`; the skin is that of the sessions with EIT.
        executor: default: a pool of spawned processes with one thread of computation each. Another example is
            `distributed.Client(address).get_executor(pure=False)`; its workers must see the same files.
        jobs: number of processes of the default pool; default: one per core.
        report: whether to write ``out/NAME.html`` too.
        tell: called with the outcome of each session when the session ends.
        finishing: called with the number of sessions that still run, after a `KeyboardInterrupt`.

    After a first `KeyboardInterrupt` no other session begins, and it is raised again when those that run have ended; a
    second one ends the processes of the default pool at once. The same call goes on with what is not done.

    A session without EIT is a log of force and pressure: it gets the calibration of a log, as by `calibrate`.
    The outcome of a session that fails names the reason, and the other sessions complete. The default pool also
    survives a session that kills its worker. Call this function below ``if __name__ == "__main__":``, because spawned
    processes import the main module.

    Raises:
        SessionError: a path stands in the place of the list, two sessions would have one result, or the folder cannot
            be made.
        ReportError: a report is wanted and matplotlib is not installed.

    Example:
        from concurrent.futures import ThreadPoolExecutor

        one = ThreadPoolExecutor(1)  # default: a pool of processes, one per core
        for outcome in calib.calibrate_many(["session.h5"], "out", recipe=recipe, executor=one):
            print(outcome.calibration, outcome.reason or outcome.summary["force_rmse"])  # N
    """
    if report:
        require_matplotlib()
    require_skin_or_none(skin, "calibrate_many")
    recipe = recipe_or_default(recipe, "calibrate_many")
    tasks = _tasks(paths_of(paths, "calibrate_many"), Path(out), report, skin, recipe, ignore_errors)
    outcomes: dict[str, Outcome] = {}

    def note(outcome: Outcome) -> None:
        outcomes[outcome.session] = outcome
        tell(outcome)

    if executor is None:
        _run_in_pools(tasks, jobs or os.cpu_count() or 1, note, finishing)
    else:
        for task in _run(executor, tasks, len(tasks), note, finishing):
            note(_failed(task, _DIED))
    return tuple(outcomes[task.session] for task in tasks)


def _tasks(
    paths: Sequence[str | os.PathLike[str]],
    out: Path,
    report: bool,
    skin: je.Skin | None,
    recipe: Recipe,
    ignore_errors: bool,
) -> list[_CalibrationTask]:
    mark = digest(recipe.to_toml(), describe(skin), str(ignore_errors), je.__version__, jax.__version__)
    shared: dict[str, Any] = {
        "report": report,
        "choices": pickle.dumps((skin, recipe, ignore_errors)),
        "mark": mark,
        "settings": settings(),
    }
    names: dict[str, str] = {}
    tasks = []
    for session in dict.fromkeys(os.path.abspath(path) for path in paths):
        name = f"{Path(session).stem}.h5"
        if name in names:
            raise SessionError(
                f"{session}: its result would be {name}, as that of {names[name]}; rename one, or calibrate them into "
                "folders of their own"
            )
        names[name] = session
        if os.path.abspath(out / name) == session:
            raise SessionError(f"{session}: its result would take its place; choose another folder for the output")
        tasks.append(_CalibrationTask(session, os.path.abspath(out / name), **shared))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SessionError(f"{out}: no folder can be made there ({error.strerror}); choose another") from error
    return tasks


def render_outcomes(outcomes: Sequence[Outcome], out: str | os.PathLike[str]) -> str:
    """The results as a table for a terminal."""
    width = max([len("session"), *(len(Path(o.session).name) for o in outcomes)])
    head = f"{'session':<{width}}  presses      CV (calibrated)   RMSE, N   % of largest"
    failed = sum(bool(o.reason) for o in outcomes)
    skipped = sum(o.skipped for o in outcomes)
    ended = f"{len(outcomes) - failed} calibrations in {out}" + (f", {skipped} of them done before" if skipped else "")
    return "\n".join([head, *(_line(o, width) for o in outcomes), "", ended + (f"; {failed} failed" if failed else "")])


def _line(outcome: Outcome, width: int) -> str:
    name = f"{Path(outcome.session).name:<{width}}"
    if outcome.reason:
        return f"{name}  FAILED: {outcome.reason}"
    s = outcome.summary
    cv = s.get("cv_calibrated_ddof1", float("nan"))
    kind = f"{s['presses']:9.0f}{cv:21.3f}" if "presses" in s else f"{'log':>9}{'':21}"
    numbers = f"{kind}{s['force_rmse']:10.2f}{s['force_rmse_percent_full_scale']:15.1f}"
    return name + numbers + ("   SIMULATED" if outcome.simulated else "")


# --- running -------------------------------------------------------------------------------------


def _run_in_pools(
    tasks: Sequence[_CalibrationTask], jobs: int, note: Callable[[Outcome], None], finishing: Callable[[int], object]
) -> None:
    """Run the tasks in pools of processes; a session whose worker died is tried once more in a process of its own."""
    left = list(tasks)
    try:
        while left:
            now, later = left[: jobs * _SESSIONS_PER_WORKER], left[jobs * _SESSIONS_PER_WORKER :]
            with _pool(min(jobs, len(now))) as pool:
                broken = _run(pool, now, jobs, note, finishing)
            suspects = [task for task in broken if lock_of(task.calibration).exists()] or broken[:1]
            for task in suspects:
                with _pool(1) as alone:
                    died = bool(_run(alone, [task], 1, note, finishing))
                if died:
                    lock_of(task.calibration).unlink(missing_ok=True)
                    note(_failed(task, _DIED))
            left = [task for task in broken if task not in suspects] + later
    except KeyboardInterrupt:
        for task in tasks:
            remove_unfinished(task.calibration)
        raise


@contextlib.contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes, which an interruption ends at once: `_run` has awaited those that it is to await."""
    with spawned_pool(jobs) as pool:
        try:
            yield pool
        except KeyboardInterrupt:
            end_workers(pool)
            raise


def _run(
    executor: Executor,
    tasks: Sequence[_CalibrationTask],
    at_once: int,
    note: Callable[[Outcome], None],
    finishing: Callable[[int], object],
) -> list[_CalibrationTask]:
    """Run all tasks and collect their outcomes; returns the tasks that a broken executor did not do."""
    broken = list(tasks)

    def collect(task: _CalibrationTask, future: Future[Outcome]) -> None:
        outcome = _outcome_of(future, task)
        if outcome is not None:
            broken.remove(task)
            note(outcome)

    run_tasks(executor, calibrate_one, tasks, at_once, collect, finishing)
    return broken


def _outcome_of(future: Future[Outcome], task: _CalibrationTask) -> Outcome | None:
    """The outcome of a task that has ended; None if its executor broke."""
    try:
        return future.result()
    except BrokenExecutor:
        return None
    except Exception as error:  # errors of the scheduler itself, of any type
        return _failed(task, _error_text(error))


def _failed(task: _CalibrationTask, reason: str, seconds: float = 0.0) -> Outcome:
    return Outcome(task.session, task.calibration, reason, seconds=seconds)


def _error_text(error: Exception) -> str:
    """The message of an error, on one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, (ValueError, OSError)) and text else f"{type(error).__name__}: {text}"


# --- in the worker -------------------------------------------------------------------------------


def calibrate_one(task: _CalibrationTask) -> Outcome:
    """Do one task, unless it is done already; does not raise for a session that cannot be calibrated."""
    start = time.perf_counter()
    with ONE_AT_A_TIME:
        take_over(task.settings)
        try:
            with exclusive(task.calibration):
                return replace(_do_task(task), seconds=time.perf_counter() - start)
        except Exception as error:
            reason = _error_text(error).removeprefix(f"{Path(task.session).name}: ")
            return _failed(task, reason, time.perf_counter() - start)


def _do_task(task: _CalibrationTask) -> Outcome:
    """Do a task and return its outcome."""
    with open_session(task.session) as session:
        calibration, skipped = _ensure_calibration(task, session, digest(session.hash, task.mark))
    skipped &= not _ensure_report(task, calibration)
    summary = calibration.evaluation.summary()
    return Outcome(task.session, task.calibration, "", skipped, calibration.simulated, summary=summary)


def _ensure_calibration(
    task: _CalibrationTask, session: Session, mark: str
) -> tuple[Calibration | LogCalibration, bool]:
    """The calibration of a task, and whether it existed already."""
    with contextlib.suppress(SessionError):
        found = load_calibration(task.calibration)
        if found.provenance.get("batch") == mark:
            return found, True
    _page_of(task).unlink(missing_ok=True)  # of an earlier calibration
    skin, recipe, ignore_errors = pickle.loads(task.choices)
    own = None if are_logs([session], "calibrate") else skin
    made: Calibration | LogCalibration = calibrate([session], own, recipe=recipe, ignore_errors=ignore_errors)
    made = replace(made, provenance=made.provenance | {"batch": mark})
    made.save(task.calibration)
    return made, False


def _ensure_report(task: _CalibrationTask, calibration: Calibration | LogCalibration) -> bool:
    """Write the report unless it exists; returns whether it was written. The page is the last of its files."""
    if not task.report or _page_of(task).exists():
        return False
    write_report(calibration, _page_of(task))
    return True


def _page_of(task: _CalibrationTask) -> Path:
    return Path(task.calibration).with_suffix(".html")
