"""Frames for training as Parquet: a file of frames for each shard, and one of skins.

A file that lies in the folder whole is not written again.
"""

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from ..bench import BenchError, open_training_frames
from ..bench.training.frame_shards import SHARDS, TABLES_EXTRA, Shard, by_frame
from ..bench.training.training_frames import TrainingFrames, claim_folder
from ..session.importers.child import library


class ParquetSummary(NamedTuple):
    """What `export_training_frames` has written: frames and skins in the folder, and its size in bytes."""

    frames: int
    skins: int
    nbytes: int

    def __str__(self) -> str:
        return f"{self.frames:,} frames on {self.skins} skins, {self.nbytes / 1e6:.1f} MB"


def export_training_frames(
    folder: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    progress: Callable[[Iterable[TrainingFrames]], Iterable[TrainingFrames]] = iter,
) -> ParquetSummary:
    """Write frames of `calib.write_training_frames` as Parquet.

    The output holds ``card.json``, ``shard-000000.parquet`` and so on, with a row for each frame, and
    ``skins.parquet``, with a row for each shard: the readings and pressures of its skin without contact. Units and
    meanings are in the metadata of the columns. `calib.open_training_frames` reads the output, too. After an
    interruption the same call goes on. ``file_format="parquet"`` of `calib.bench.FrameSet` makes the same
    files at once.

    Args:
        folder: of the frames.
        output: an empty or new folder, or one that this function has begun to write.
        progress: wraps the shards, as `tqdm.tqdm` does.

    Raises:
        BenchError: the folder has no frames, or the output holds other files.
        ImportError: without the library `pyarrow`, of the extra ``tables``.

    Example:
        from concurrent.futures import ThreadPoolExecutor

        bench, one = calib.load_bench("paper_bench"), ThreadPoolExecutor(1)  # default: a pool of processes
        fidelity, pixels = je.Fidelity.draft(dtype="float32"), je.Pixels(10)
        frame_set = calib.bench.FrameSet(bench, 1024, fidelity, pixels)
        calib.write_training_frames(frame_set, "frames", executor=one)
        # for pandas, Polars, DuckDB and Hugging Face datasets
        print(calib.export_training_frames("frames", "parquet"))
    """
    library("pyarrow.parquet", TABLES_EXTRA)
    frames, output = open_training_frames(folder), Path(output)
    if output.resolve() == Path(folder).resolve():
        raise BenchError(f"{output}: holds the frames themselves; give another folder")
    card = {**frames.card, "file_format": "parquet"}
    claim_folder(output, json.dumps(card, indent=2) + "\n")
    files, about, mark = SHARDS["parquet"], frames.card["arrays"], frames.card["mark"]
    rows = by_frame(about)
    for skin in progress(list(frames.skins())):
        path = files.path(output, skin.shards[0])
        if not files.is_whole(path, mark, len(skin)):
            (arrays,) = skin.batches(len(skin), *rows)
            of_skin = {name: skin[name][0] for name in about if name not in rows}
            shard = dict(zip(rows, arrays, strict=True)) | of_skin
            files.write(path, Shard(skin.shards[0], shard, about, mark))
    files.finish(output, frames.shards, about)
    size = sum(path.stat().st_size for path in output.glob("*.parquet"))
    return ParquetSummary(len(frames), len(frames.shards), size)
