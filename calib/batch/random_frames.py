"""Write frames of random scenes for training, by several processes or a cluster.

A shard is a function of the card and of its number, computed by one thread: equal cards give equal bytes, whatever the
number of processes. A shard that lies in the folder whole is not made again.
"""

import os
import pickle
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxeit.messages.kinds import require_kind

from ..bench import BenchError, FrameSet
from ..bench.training.frame_shards import SHARDS, TABLES_EXTRA, Shard
from ..bench.training.scene_frames import SceneFrames
from ..bench.training.training_frames import CARD, FRAMES_VERSION, card_of, claim_folder
from ..runtime import settings, take_over
from ..session import file_hash, replacing
from ..session.importers.child import library
from ..session.outputs import remove_abandoned
from .digests import describe, digest
from .workers import ONE_AT_A_TIME, end_workers, run_tasks, spawned_pool

HASHES = "SHA256SUMS"
_DIED = "a worker process died, most likely for want of memory; the same command goes on, with fewer --jobs"


@dataclass(frozen=True)
class WrittenFrames:
    """What `write_training_frames` has done.

    | field                                                   | unit |
    |---------------------------------------------------------|------|
    | folder of the card and the shards                       |      |
    | frames in the folder                                    |      |
    | made: frames of them that were not there before         |      |
    | nbytes: size of all shards                              | byte |
    """

    folder: Path
    frames: int
    made: int
    nbytes: int


@dataclass(frozen=True)
class _ShardTask:
    """A shard, and all that a worker needs to know; the frame set is pickled, as in `calib.batch.sessions`."""

    folder: str
    number: int
    choices: bytes
    mark: str
    settings: Mapping[str, Any]


def write_training_frames(
    frame_set: FrameSet,
    folder: str | Path,
    *,
    executor: Executor | None = None,
    jobs: int = 1,
    begin: Callable[[int, int], object] = lambda frames, nbytes: None,
    tell: Callable[[int], object] = lambda frames: None,
    finishing: Callable[[int], object] = lambda running: None,
) -> WrittenFrames:
    """Simulate frames of random contacts, with pressures, contacts and true force maps, and write them in shards.

    Each shard of 1,024 frames is another skin of the scene: the seeds of all effects are drawn. Effects that the scene
    does not list are not simulated. `calib.open_training_frames` reads the folder; ``card.json`` describes it. Equal
    sets give equal bytes on the same machine, whatever the number of processes. After a first `KeyboardInterrupt` no
    other shard begins, and it is raised again when those that are being made are written; a second one ends the
    processes of the default pool at once. The same call goes on. Call this function below
    ``if __name__ == "__main__":``, because spawned processes import the main module.

    Args:
        frame_set: the scene, the number of frames, and how they are simulated and stored; `calib.bench.FrameSet`.
        folder: new, empty, or with shards of the same set, of which there may be fewer.
        executor: default: a pool of spawned processes with one thread of computation each. Another example is
            `distributed.Client(address).get_executor(pure=False)`; its workers must see the same folder.
        jobs: number of processes of the default pool.
        begin: called before the work with the number of frames to make, and an upper bound of their bytes.
        tell: called with the number of frames of each shard when it is written.
        finishing: called with the number of shards that are being made, after a `KeyboardInterrupt`.

    Raises:
        BenchError: nothing can be simulated so; the folder holds something else; the disk has too little space; a
            process died.
        ImportError: ``parquet`` without the library `pyarrow`.

    Example:
        from concurrent.futures import ThreadPoolExecutor

        bench, one = calib.load_bench("paper_bench"), ThreadPoolExecutor(1)  # default: a pool of processes
        fidelity, pixels = je.Fidelity.draft(dtype="float32"), je.Pixels(10)
        frame_set = calib.bench.FrameSet(bench, 1024, fidelity, pixels)
        calib.write_training_frames(frame_set, "frames", executor=one)
        for readings, maps in calib.open_training_frames("frames").batches(
            64, "frames", "force_map", seed=0
        ):
            pass  # a step of the training
    """
    give = "calib.bench.FrameSet(calib.load_bench(path), frames)"
    require_kind(frame_set, FrameSet, BenchError, "a FrameSet", give, "write_training_frames")
    if jobs < 1:
        raise BenchError(f"{jobs} jobs; give one or more")
    folder, versions = Path(folder), _versions(frame_set.file_format)
    # A folder may get more frames, so that the number of frames is no part of the mark.
    mark = digest(describe(replace(frame_set, frames=1)), str(FRAMES_VERSION), *versions.values())
    found = folder.exists()
    claim_folder(folder, card_of(frame_set, mark, versions))
    files, rows = SHARDS[frame_set.file_format], frame_set.rows
    left = [n for n in range(frame_set.shards) if not files.is_whole(files.path(folder, n), mark, rows(n))]
    to_make, nbytes = sum(map(rows, left)), frame_set.nbytes(left)
    try:
        _require_space(folder, nbytes)
        begin(to_make, nbytes)
        _run(executor, jobs, _tasks(folder, frame_set, mark, left), lambda number: tell(rows(number)), finishing)
    except Exception:
        _leave_folder(folder, found)
        raise
    except KeyboardInterrupt:
        for number in left:  # of workers that a second interruption ended
            remove_abandoned(files.path(folder, number))
        raise
    return WrittenFrames(folder, frame_set.frames, to_make, _finish_folder(folder, frame_set))


def _versions(file_format: str) -> dict[str, str]:
    """Versions of the libraries that the bytes of a shard depend on."""
    found = {"jaxeit": metadata.version("jaxeit"), "jax": jax.__version__, "numpy": np.__version__}
    return found | ({"pyarrow": library("pyarrow", TABLES_EXTRA).__version__} if file_format == "parquet" else {})


def _tasks(folder: Path, made: FrameSet, mark: str, numbers: Iterable[int]) -> list[_ShardTask]:
    """The tasks that make the shards of these numbers."""
    choices, chosen = pickle.dumps(made), settings()
    return [_ShardTask(str(folder.absolute()), number, choices, mark, chosen) for number in numbers]


def _require_space(folder: Path, nbytes: int) -> None:
    free = shutil.disk_usage(folder).free
    if nbytes > free:
        raise BenchError(
            f"{folder}: the frames take up to {nbytes / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; write fewer "
            "frames or pixels, or choose another disk"
        )


def _leave_folder(folder: Path, found: bool) -> None:
    """Remove the card of frames of which no shard could be made, and the folder, unless it was found."""
    if os.listdir(folder) == [CARD]:
        (folder / CARD).unlink()
        if not found:
            folder.rmdir()


def _run(
    executor: Executor | None,
    jobs: int,
    tasks: Sequence[_ShardTask],
    tell: Callable[[int], object],
    finishing: Callable[[int], object],
) -> None:
    """Make all shards, by the executor or by a pool of so many processes, which lasts as long as the work."""
    if executor is not None:
        _run_in(executor, tasks, len(tasks), tell, finishing)
    elif tasks:
        with spawned_pool(min(jobs, len(tasks))) as pool:
            try:
                _run_in(pool, tasks, jobs, tell, finishing)
            except KeyboardInterrupt:
                end_workers(pool)  # `run_tasks` has awaited those that it is to await
                raise


def _run_in(
    executor: Executor,
    tasks: Sequence[_ShardTask],
    at_once: int,
    tell: Callable[[int], object],
    finishing: Callable[[int], object],
) -> None:
    def collect(task: _ShardTask, future: Future[None]) -> None:
        future.result()
        tell(task.number)

    try:
        left = run_tasks(executor, make_shard, tasks, at_once, collect, finishing)
    except BrokenExecutor as error:
        raise BenchError(_DIED) from error
    if left:
        raise BenchError(_DIED)


def _finish_folder(folder: Path, made: FrameSet) -> int:
    """Write what stands beside the shards, and their hashes for ``sha256sum --check``; returns their bytes."""
    files = SHARDS[made.file_format]
    files.finish(folder, range(made.shards), made.described)
    paths = [files.path(folder, number) for number in range(made.shards)]
    lines = [f"{file_hash(path)}  {path.name}\n" for path in paths]
    with replacing(folder / HASHES) as temporary:
        temporary.write_text("".join(lines), encoding="ascii")
    return sum(path.stat().st_size for path in paths)


# --- in the worker -------------------------------------------------------------------------------


def make_shard(task: _ShardTask) -> None:
    """Simulate and write one shard."""
    with ONE_AT_A_TIME:
        take_over(task.settings)
        made, simulator = _simulator(task.choices)
        arrays = simulator.simulate(task.number, made.seed, made.rows(task.number))
        files, skin = SHARDS[made.file_format], made.bench.scene.skin.name
        shard = Shard(task.number, arrays, made.described, task.mark, skin, made.seed, made.sizes, simulator.pixels)
        files.write(files.path(Path(task.folder), task.number), shard)


@lru_cache(maxsize=1)
def _simulator(choices: bytes) -> tuple[FrameSet, SceneFrames]:
    """The frame set and its simulator, which serves all shards of this process."""
    made: FrameSet = pickle.loads(choices)
    return made, SceneFrames(made.bench, made.fidelity, made.pixels, made.scenes)
