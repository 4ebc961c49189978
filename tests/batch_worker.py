"""A batch whose sessions take no time to calibrate, to be killed.

    python -m tests.batch_worker MADE LOG OUT SESSION...
    python -m tests.batch_worker held MADE GATE calibrate ...

Workers give every session the calibration MADE, and write a line to LOG for each result that they have saved.
"""

import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from calib import cli
from calib.batch import sessions as batch
from calib.batch.workers import begin
from calib.calibration.calibration import Calibration, load_calibration


def begin_quick(made: str, log: str) -> None:
    """In place of `calib.batch.workers.begin`."""
    begin()
    ready, save = load_calibration(made), Calibration.save

    def logged(self, path):
        save(self, path)
        file = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(file, f"{path}\n".encode())
        os.close(file)

    Calibration.save = logged
    batch.calibrate = lambda sessions, skin, **options: ready


def begin_deadly(made: str) -> None:
    """A session named kills.h5 ends its worker without a word, as the kernel does when memory runs out."""
    begin()
    ready = load_calibration(made)

    def calibrate(sessions, skin, **options):
        if sessions[0].name == "kills.h5":
            os._exit(9)
        return ready

    batch.calibrate = calibrate


def deadly_pool(jobs: int, made: str) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, mp_context=context, initializer=begin_deadly, initargs=(made,))


def begin_held(made: str, gate: str) -> None:
    """Every session says in the folder ``gate`` that it has begun, and waits there for the file ``go``."""
    begin()
    ready = load_calibration(made)

    def calibrate(sessions, skin, **options):
        Path(gate, sessions[0].name).touch()
        while not Path(gate, "go").exists():
            time.sleep(0.02)
        return ready

    batch.calibrate = calibrate


def held_command(made: str, gate: str, *words: str) -> int:
    """The command line, with workers that wait."""
    context = multiprocessing.get_context("spawn")
    batch.spawned_pool = lambda jobs: ProcessPoolExecutor(
        jobs, mp_context=context, initializer=begin_held, initargs=(made, gate)
    )
    return cli.main(words)


def main(made: str, log: str, out: str, *sessions: str) -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context, initializer=begin_quick, initargs=(made, log)) as pool:
        batch.calibrate_many(sessions, out, executor=pool)


if __name__ == "__main__":
    if sys.argv[1] == "held":
        sys.exit(held_command(*sys.argv[2:]))
    main(*sys.argv[1:])
