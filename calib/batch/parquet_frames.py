"""Frames for training as Parquet: a file of frames for each shard, and one of skins.

Columns are lists of fixed size, as pandas, Polars, DuckDB and Hugging Face datasets read them. Each file is written
whole or not at all, and a file that lies in the folder whole is not written again.
"""

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..bench import BenchError, open_training_frames
from ..bench.training_frames import CARD, TrainingFrames, claim_folder
from ..session import replacing
from ..session.importers.child import library

EXTRA = "tables"
MARK = b"jaxeit_mark"  # key of a file's metadata: of the card that its frames belong to
SKINS = "skins.parquet"


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
    meanings are in the metadata of the columns. After an interruption the same call goes on.

    Args:
        folder: of the frames.
        output: an empty or new folder, or one that this function has begun to write.
        progress: wraps the shards, as `tqdm.tqdm` does.

    Raises:
        BenchError: the folder has no frames, or the output holds other files.
        ImportError: without the library `pyarrow`, of the extra ``tables``.
    """
    library("pyarrow.parquet", EXTRA)
    frames, output = open_training_frames(folder), Path(output)
    if output.resolve() == Path(folder).resolve():
        raise BenchError(f"{output}: holds the frames themselves; give another folder")
    claim_folder(output, (Path(folder) / CARD).read_text(encoding="utf-8"))
    by_frame = [name for name, about in frames.card["arrays"].items() if about["axes"][0] == "frame"]
    by_skin = [name for name in frames.card["arrays"] if name not in by_frame]
    for skin in progress(list(frames.skins())):
        path = output / f"shard-{skin.shards[0]:06d}.parquet"
        if not _is_whole(path, skin):
            (arrays,) = skin.batches(len(skin), *by_frame)
            columns = {"shard": np.full(len(skin), skin.shards[0], "i4")}
            _write(path, columns | dict(zip(by_frame, arrays, strict=True)), frames.card)
    columns = {"shard": np.arange(len(frames.shards), dtype="i4")} | {name: frames[name] for name in by_skin}
    _write(output / SKINS, columns, frames.card)
    size = sum(path.stat().st_size for path in output.glob("*.parquet"))
    return ParquetSummary(len(frames), len(frames.shards), size)


def _is_whole(path: Path, skin: TrainingFrames) -> bool:
    """Whether a file has all frames of a shard; `replacing` leaves no half of a file."""
    if not path.is_file():
        return False
    about = library("pyarrow.parquet", EXTRA).read_metadata(path)
    return bool(about.num_rows == len(skin) and about.metadata.get(MARK) == skin.card["mark"].encode())


def _write(path: Path, columns: dict[str, np.ndarray], card: Any) -> None:
    pa, parquet = library("pyarrow", EXTRA), library("pyarrow.parquet", EXTRA)
    arrays = [_lists(pa, values) for values in columns.values()]
    fields = [
        pa.field(name, array.type, nullable=False, metadata=_about(card["arrays"].get(name)))
        for name, array in zip(columns, arrays, strict=True)
    ]
    table = pa.table(arrays, schema=pa.schema(fields, metadata={MARK: card["mark"].encode()}))
    with replacing(path) as temporary:
        parquet.write_table(table, temporary, compression="zstd")


def _lists(pa: Any, values: np.ndarray) -> Any:
    """An array (rows, ...) as a column: each row a list of fixed size, of lists where there are more axes."""
    column = pa.array(np.ascontiguousarray(values).ravel())
    for size in reversed(values.shape[1:]):
        column = pa.FixedSizeListArray.from_arrays(column, size)
    return column


def _about(array: Any) -> dict[str, str] | None:
    if array is None:
        return None
    return {"meaning": array["meaning"], "unit": array["unit"], "axes": json.dumps(array["axes"])}
