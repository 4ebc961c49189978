"""Files of frames for training, one for each drawn skin: HDF5 with named axes, or Parquet with a row for each frame.

Either is written whole or not at all, and equal arrays give equal bytes.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxeit as je

from ...session import ArchiveWriter, SessionError, open_archive, replacing
from ...session.importers.child import library
from ..bench import BenchError
from .scene_frames import SHARD_FRAMES

SHARD_FORMAT = "skin-training-frames"
TABLES_EXTRA = "tables"
SKINS = "skins.parquet"
MARK, SKIN = b"jaxeit_mark", b"jaxeit_skin"  # metadata of a Parquet file: its card, and the arrays of its skin

Arrays = Mapping[str, np.ndarray]
Descriptions = Mapping[str, Mapping[str, Any]]  # "meaning", "unit", "axes", "shape" and "dtype" of each array


def by_frame(about: Descriptions) -> list[str]:
    """Names of the arrays with a row for each frame; the others belong to the skin of a shard."""
    return [name for name, each in about.items() if each["axes"][0] == "frame"]


class Shard(NamedTuple):
    """A shard to write: its number, the arrays and what they are, and facts about all shards of the folder."""

    number: int
    arrays: Arrays
    about: Descriptions
    mark: str
    skin: str = ""
    seed: int = 0
    sizes: Mapping[str, int] = {}  # lengths of all axes but that of the frames
    pixels: je.model.BasisMap | None = None


class AbstractShards(ABC):
    """How shards are kept as files."""

    suffix: str

    def path(self, folder: Path, number: int) -> Path:
        """Path of a shard."""
        return folder / f"shard-{number:06d}{self.suffix}"

    @abstractmethod
    def is_whole(self, path: Path, mark: str, rows: int) -> bool:
        """Whether a shard has all its frames and was made for a card with this mark."""

    @abstractmethod
    def write(self, path: Path, shard: Shard) -> None:
        """Write one shard."""

    @abstractmethod
    def read(self, path: Path, names: Collection[str], mark: str, rows: int) -> dict[str, np.ndarray]:
        """Some arrays of a shard.

        Raises:
            BenchError: the shard belongs to another card, or lacks frames.
        """

    @abstractmethod
    def finish(self, folder: Path, shards: range, about: Descriptions) -> None:
        """Write what belongs to all shards, when they are there."""


class HDF5Shards(AbstractShards):
    """HDF5 with named axes, which h5py and xarray open too."""

    suffix = ".h5"

    def is_whole(self, path: Path, mark: str, rows: int) -> bool:
        if not path.is_file():
            return False
        try:
            with open_archive(path, SHARD_FORMAT) as shard:
                return shard.attrs.get("mark") == mark and shard.arrays["frame"].shape == (rows,)
        except SessionError:
            return False

    def write(self, path: Path, shard: Shard) -> None:
        pixels = shard.pixels
        assert pixels is not None
        attrs: dict[str, str | bool | int] = {
            "title": f"frames of random contacts on {shard.skin}",
            "skin": shard.skin,
            "simulated": True,
            "shard": shard.number,
            "seed": shard.seed,
            "mark": shard.mark,
            "image_rows": pixels.shape[0],
            "image_columns": pixels.shape[1],
            "coordinates": "x y",
        }
        first, rows = shard.number * SHARD_FRAMES, len(shard.arrays["frames"])
        with ArchiveWriter(path, SHARD_FORMAT, attrs) as writer:
            writer.add("frame", np.arange(first, first + rows, dtype="i8"), "1", "number of the frame", ("frame",))
            for name, size in shard.sizes.items():
                writer.add(name, np.arange(size, dtype="i4"), "1", f"number of the {name}", (name,))
            for name, values in zip("xy", np.asarray(pixels.centres).T, strict=True):
                writer.add(name, values, "m", f"centres of the pixels along {name}", ("pixel",))
            writer.add("areas", np.asarray(pixels.areas), "m2", "areas of the pixels", ("pixel",))
            for name, about in shard.about.items():
                values = shard.arrays[name].astype(about["dtype"])
                writer.add(name, values, about["unit"], about["meaning"], tuple(about["axes"]))

    def read(self, path: Path, names: Collection[str], mark: str, rows: int) -> dict[str, np.ndarray]:
        with open_archive(path, SHARD_FORMAT) as shard:
            _require(path, shard.attrs.get("mark") == mark, shard.arrays["frame"].shape == (rows,))
            return {name: shard.arrays[name].read() for name in names}

    def finish(self, folder: Path, shards: range, about: Descriptions) -> None:
        """Nothing: each shard is whole in itself."""


class ParquetShards(AbstractShards):
    """Parquet, as pandas, Polars, DuckDB and Hugging Face datasets read it; needs `pyarrow`, of the extra ``tables``.

    Columns are lists of fixed size, whose metadata has meaning, unit and axes. The arrays of a skin are in the metadata
    of its shard, and those of all skins in ``skins.parquet``.
    """

    suffix = ".parquet"

    def is_whole(self, path: Path, mark: str, rows: int) -> bool:
        if not path.is_file():
            return False
        parquet = library("pyarrow.parquet", TABLES_EXTRA)
        try:
            about = parquet.read_metadata(path)
        except library("pyarrow", TABLES_EXTRA).ArrowException:
            return False
        return bool(about.num_rows == rows and (about.metadata or {}).get(MARK) == mark.encode())

    def write(self, path: Path, shard: Shard) -> None:
        kinds = {name: about["dtype"] for name, about in shard.about.items()}
        columns = {"shard": np.full(len(shard.arrays["frames"]), shard.number, "i4")}
        rows = by_frame(shard.about)
        columns |= {name: shard.arrays[name].astype(kinds[name]) for name in rows}
        skin = {name: shard.arrays[name].astype(kinds[name]).tolist() for name in kinds if name not in rows}
        _write_table(path, columns, shard.about, {MARK: shard.mark.encode(), SKIN: json.dumps(skin).encode()})

    def read(self, path: Path, names: Collection[str], mark: str, rows: int) -> dict[str, np.ndarray]:
        try:
            with library("pyarrow.parquet", TABLES_EXTRA).ParquetFile(path) as file:
                metadata = file.metadata.metadata or {}
                _require(path, metadata.get(MARK) == mark.encode(), file.metadata.num_rows == rows)
                skin = json.loads(metadata[SKIN])
                kept = [name for name in names if name not in skin]
                columns = file.read(columns=kept)
        except library("pyarrow", TABLES_EXTRA).ArrowException as error:
            raise BenchError(f"{path}: is damaged ({error}); give the command that writes it again") from error
        found = {name: _array(columns[name]) for name in kept}
        return found | {name: np.asarray(skin[name], float) for name in names if name in skin}

    def finish(self, folder: Path, shards: range, about: Descriptions) -> None:
        """Write the arrays of all skins, a row for each shard."""
        read = library("pyarrow.parquet", TABLES_EXTRA).read_metadata
        metadata = [read(self.path(folder, number)).metadata for number in shards]
        skins = [json.loads(each[SKIN]) for each in metadata]
        columns = {"shard": np.asarray(shards, "i4")}
        columns |= {name: np.asarray([skin[name] for skin in skins], about[name]["dtype"]) for name in skins[0]}
        _write_table(folder / SKINS, columns, about, {MARK: metadata[0][MARK]})


SHARDS: Mapping[str, AbstractShards] = {"hdf5": HDF5Shards(), "parquet": ParquetShards()}
"""Formats of the shards by their names."""


def _require(path: Path, belongs: bool, is_whole: bool) -> None:
    if not belongs:
        raise BenchError(f"{path}: belongs to another card; write the frames again in a new folder")
    if not is_whole:
        raise BenchError(f"{path}: frames are missing; give the command that writes them again")


def _write_table(path: Path, columns: Arrays, about: Descriptions, metadata: Mapping[bytes, bytes]) -> None:
    pa, parquet = library("pyarrow", TABLES_EXTRA), library("pyarrow.parquet", TABLES_EXTRA)
    arrays = [_lists(pa, values) for values in columns.values()]
    fields = [
        pa.field(name, array.type, nullable=False, metadata=_described(about.get(name)))
        for name, array in zip(columns, arrays, strict=True)
    ]
    table = pa.table(arrays, schema=pa.schema(fields, metadata=metadata))
    with replacing(path) as temporary:
        parquet.write_table(table, temporary, compression="zstd")


def _lists(pa: Any, values: np.ndarray) -> Any:
    """An array (rows, ...) as a column: each row a list of fixed size, of lists where there are more axes."""
    column = pa.array(np.ascontiguousarray(values).ravel())
    for size in reversed(values.shape[1:]):
        column = pa.FixedSizeListArray.from_arrays(column, size)
    return column


def _array(column: Any) -> np.ndarray:
    """The array (rows, ...) of a column, the inverse of `_lists`."""
    values, shape = column.combine_chunks(), [len(column)]
    while hasattr(values.type, "list_size"):
        shape.append(values.type.list_size)
        values = values.flatten()
    found: np.ndarray = values.to_numpy(zero_copy_only=False).reshape(shape)
    return found


def _described(about: Mapping[str, Any] | None) -> dict[str, str] | None:
    if about is None:
        return None
    return {"meaning": about["meaning"], "unit": about["unit"], "axes": json.dumps(about["axes"])}
