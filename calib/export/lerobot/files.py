"""The files of a LeRobot dataset, version 3.0: Parquet files of frames and of episodes, and metadata in JSON.

After the writer and the reader of LeRobot 0.4 to 0.6 (``lerobot/datasets``): ``data/chunk-000/file-000.parquet`` has a
row for each frame, ``meta/episodes/`` one for each episode, and ``meta/info.json`` the features and the templates of
paths.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...session.importers.child import library

EXTRA = "tables"
VERSION = "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA, EPISODES = f"data/{FILE}", f"meta/episodes/{FILE}"
FILES_PER_CHUNK = 1000
FILE_MEGABYTES = 100  # a file of frames that is larger takes no further episode
DEFAULT_FEATURES: dict[str, dict[str, Any]] = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}
_PANDAS_INDEX = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ],
    "pandas_version": "2.0.0",
}
"""What pandas, by which LeRobot reads the tasks, stores of the column that is the index."""


class FrameFiles:
    """Files of frames, written block by block; a context manager."""

    def __init__(self, folder: Path, features: Mapping[str, Mapping[str, Any]]):
        self._pa, self._parquet = library("pyarrow", EXTRA), library("pyarrow.parquet", EXTRA)
        self._folder, self._features = folder, features
        self._schema = self._pa.schema([(name, self._type(feature)) for name, feature in features.items()])
        self._writer: Any = None
        self._number = -1

    def __enter__(self) -> "FrameFiles":
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def _type(self, feature: Mapping[str, Any]) -> Any:
        if feature["dtype"] == "image":
            return self._pa.struct([("bytes", self._pa.binary()), ("path", self._pa.string())])
        kind = self._pa.bool_() if feature["dtype"] == "bool" else self._pa.type_for_alias(feature["dtype"])
        if list(feature["shape"]) == [1]:
            return kind
        for _ in feature["shape"]:
            kind = self._pa.list_(kind)
        return kind

    def begin_episode(self) -> dict[str, int]:
        """Begin a file if the last one is large enough; returns the numbers of chunk and file."""
        path = self._path()
        if self._writer is None or path.stat().st_size >= FILE_MEGABYTES << 20:
            if self._writer is not None:
                self._writer.close()
            self._number += 1
            path = self._path()
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = self._parquet.ParquetWriter(path, self._schema, compression="snappy")
        chunk, file = divmod(self._number, FILES_PER_CHUNK)
        return {"data/chunk_index": chunk, "data/file_index": file}

    def _path(self) -> Path:
        chunk, file = divmod(max(self._number, 0), FILES_PER_CHUNK)
        return self._folder / DATA.format(chunk_index=chunk, file_index=file)

    def append(self, columns: Mapping[str, Any]) -> None:
        """Write frames: arrays (n, *shape), and lists of PNG files for images."""
        arrays = [self._array(columns[field.name], field) for field in self._schema]
        self._writer.write_table(self._pa.table(arrays, schema=self._schema))

    def _array(self, values: Any, field: Any) -> Any:
        if self._features[field.name]["dtype"] == "image":
            return self._pa.array([{"bytes": value, "path": None} for value in values], field.type)
        flat = np.asarray(values)
        if list(self._features[field.name]["shape"]) == [1]:
            return self._pa.array(flat.reshape(len(flat)), field.type)
        shape, found = flat.shape, self._pa.array(flat.ravel())
        for length in reversed(shape[1:]):
            found = self._pa.ListArray.from_arrays(np.arange(0, len(found) + 1, length, dtype=np.int32), found)
        return found.cast(field.type)


def write_metadata(
    folder: Path, info: Mapping[str, Any], stats: Mapping[str, Any], episodes: Sequence[Mapping[str, Any]], task: str
) -> None:
    """Write everything but the frames."""
    pa, parquet = library("pyarrow", EXTRA), library("pyarrow.parquet", EXTRA)
    path = folder / EPISODES.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    rows = [dict(row) | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0} for row in episodes]
    parquet.write_table(pa.Table.from_pylist(rows), path, compression="snappy")
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "task": [task]})
    parquet.write_table(
        tasks.replace_schema_metadata({"pandas": json.dumps(_PANDAS_INDEX)}), folder / "meta/tasks.parquet"
    )
    for name, content in (("info", info), ("stats", stats)):
        text = json.dumps(content, indent=4, allow_nan=False)
        (folder / f"meta/{name}.json").write_text(text, encoding="utf-8")


def info_of(
    features: Mapping[str, Mapping[str, Any]], fps: int, episodes: int, frames: int, robot: str
) -> dict[str, Any]:
    """The content of ``meta/info.json``."""
    return {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": FILE_MEGABYTES,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA,
        "video_path": None,
        "features": dict(features),
    }
