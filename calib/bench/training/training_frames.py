"""Folders of frames for training: shards, and a card that describes them.

A folder holds ``card.json`` and one shard per drawn skin, such as ``shard-000000.h5`` (`frame_shards`).
"""

import dataclasses
import json
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

import jaxeit as je
from jaxeit.budget import require

from ...session import replacing
from ..bench import Bench, BenchError
from .frame_shards import SHARDS, AbstractShards
from .random_scenes import MAX_CONTACTS, Footprint, RandomScenes
from .scene_frames import SHARD_FRAMES

FORMAT = "jaxeit-training-frames"
FRAMES_VERSION = 2  # of the content: equal seeds give equal frames within a version
CARD = "card.json"
COUNTS = ("frames", "shards", "arrays")  # entries of a card that change where frames are added
FIXED_BYTES = 1 << 16  # of a shard: headers


class ArrayDescription(NamedTuple):
    """What an array is: its axes, its unit, what it means, and its type."""

    dims: tuple[str, ...]
    units: str
    meaning: str
    dtype: DTypeLike = "f4"


FOOTPRINTS = ", ".join(f"{kind.value} {kind.name.lower()}" for kind in Footprint)
ARRAYS = {
    "frames": ArrayDescription(("frame", "reading"), "V", "change of the readings against the untouched skin"),
    "untouched": ArrayDescription(
        ("reading",), "V", "readings of the untouched skin of this shard, mean of 128 frames", "f8"
    ),
    "pressures": ArrayDescription(
        ("frame", "pad"), "Pa", "change of the pressures in the pads against the untouched skin"
    ),
    "untouched_pressures": ArrayDescription(("pad",), "Pa", "pressures in the pads of the untouched skin", "f8"),
    "pad_forces": ArrayDescription(("frame", "pad"), "N", "force on each pad: the pad's mask times the force map"),
    "force_map": ArrayDescription(("frame", "pixel"), "N", "force on each pixel, the sum of all contacts"),
    "contacts": ArrayDescription(("frame",), "1", "number of contacts; the further rows of a frame are 0", "u1"),
    "contact_place": ArrayDescription(("frame", "contact", "axis"), "m", "middle of each contact"),
    "contact_force": ArrayDescription(
        ("frame", "contact"), "N", "force of each contact; what lies beside the sheet is lost"
    ),
    "contact_footprint": ArrayDescription(("frame", "contact"), "1", FOOTPRINTS, "u1"),
    "contact_size": ArrayDescription(("frame", "contact"), "m", "radius of a disc or ring, half the length of an edge"),
    "contact_angle": ArrayDescription(("frame", "contact"), "rad", "direction of an edge against x"),
    "load_spread": ArrayDescription(
        ("frame",), "m", "standard deviation by which the pad spreads each tip; 0: flat tips"
    ),
}
"""Arrays of a shard by their names; a skin without pads has no arrays with an axis of pads."""


@dataclasses.dataclass(frozen=True)
class FrameSet:
    """A set of frames for training, by everything that its bytes depend on: to be written by `write_training_frames`.

    | field                                                          | default                      |
    |----------------------------------------------------------------|------------------------------|
    | bench: scene, tip, rates, temperature, and seed of all draws   |                              |
    | frames: their number                                           |                              |
    | fidelity of the simulation                                     | `jaxeit.Fidelity.standard()` |
    | pixels of the force maps                                       | as those of a calibration    |
    | scenes: distributions that contacts are drawn from             | `RandomScenes()`             |
    | file_format of the shards, ``hdf5`` or ``parquet``             | ``hdf5``                     |

    Presses of the bench are not used. Parquet is for pandas, Polars, DuckDB and Hugging Face datasets; it has
    ``skins.parquet`` beside the shards, and needs the extra ``tables``.

    Raises:
        BenchError: for less than one frame, or a seed below 0 or beyond 2^63 - 1.

    Example:
        drawn, scenes = replace(bench, seed=7), calib.bench.RandomScenes(force=(1, 50))  # N
        frame_set = calib.bench.FrameSet(drawn, 2048, fidelity=je.Fidelity.draft(), scenes=scenes)
        print(frame_set.shards, frame_set.sizes)
    """

    bench: Bench
    frames: int
    fidelity: je.Fidelity = dataclasses.field(default_factory=je.Fidelity.standard)
    pixels: je.Pixels = dataclasses.field(default_factory=je.Pixels)
    scenes: RandomScenes = dataclasses.field(default_factory=RandomScenes)
    file_format: str = "hdf5"

    def __post_init__(self) -> None:
        if self.pixels.rows is None:  # their number must not depend on the mesh
            (x0, y0), (x1, y1) = self.bench.scene.skin.domain.bounds
            rows = max(1, round(self.pixels.columns * (y1 - y0) / (x1 - x0)))
            object.__setattr__(self, "pixels", je.Pixels(self.pixels.columns, rows))
        if self.file_format not in SHARDS:
            raise BenchError(f"file format {self.file_format!r}: no such format; give {' or '.join(SHARDS)}")
        if self.frames < 1:
            raise BenchError(f"{self.frames} frames make no data set; give one or more")
        if not 0 <= self.seed < 2**63:
            raise BenchError(f"the seed is {self.seed}; give 0 to 2^63 - 1")

    @property
    def seed(self) -> int:
        """Of all that is drawn."""
        return self.bench.seed

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.frames // SHARD_FRAMES)

    def rows(self, number: int) -> int:
        """Number of frames in a shard; the last one may have fewer."""
        return _rows(self.frames, number)

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of all axes but that of the frames."""
        skin = self.bench.scene.skin
        pixels = self.pixels.columns * (self.pixels.rows or 0)
        sizes = {"reading": skin.protocol.readings, "pixel": pixels, "contact": MAX_CONTACTS, "axis": 2}
        return sizes | ({"pad": len(skin.pads)} if skin.pads else {})

    @property
    def arrays(self) -> dict[str, ArrayDescription]:
        """The arrays of a shard."""
        return {name: about for name, about in ARRAYS.items() if {*about.dims} <= {*self.sizes, "frame"}}

    @property
    def described(self) -> dict[str, dict[str, Any]]:
        """What the arrays are, as in the card."""
        return {
            name: {
                "meaning": about.meaning,
                "axes": about.dims,
                "shape": [self.frames if dim == "frame" else self.sizes[dim] for dim in about.dims],
                "dtype": np.dtype(about.dtype).name,
                "unit": about.units,
            }
            for name, about in self.arrays.items()
        }

    def nbytes(self, numbers: Collection[int]) -> int:
        """Upper bound of the bytes of some shards."""
        each = [a for a in self.arrays.values() if a.dims[0] == "frame"]
        counts = [int(np.prod([self.sizes[d] for d in a.dims[1:]], dtype=int)) for a in each]
        frame = sum(np.dtype(a.dtype).itemsize * count for a, count in zip(each, counts, strict=True))
        fixed = FIXED_BYTES + 8 * (sum(self.sizes.values()) + 3 * self.sizes["pixel"] + self.sizes["reading"])
        return sum(self.rows(number) * frame + fixed for number in numbers)


def _rows(frames: int, number: int) -> int:
    """Number of frames in a shard of a set of so many."""
    return min(SHARD_FRAMES, frames - number * SHARD_FRAMES)


def card_of(made: FrameSet, mark: str, versions: Mapping[str, str]) -> str:
    """The card: what the frames are, what they were drawn from, and how to draw them again; JSON."""
    skin = made.bench.scene.skin
    card = {
        "format": FORMAT,
        "version": FRAMES_VERSION,
        "simulated": True,
        "frames": made.frames,
        "shards": made.shards,
        "frames_per_shard": SHARD_FRAMES,
        "seed": made.seed,
        "skin": skin.name,
        "skin_toml": skin.toml,
        "scene_toml": made.bench.toml,
        "effects": [type(effect).__name__ for effect in made.bench.scene.effects],
        "tip_diameter_m": made.bench.tip_diameter,
        "fidelity": str(made.fidelity),
        "pixels": str(made.pixels),
        "drawn_from": dataclasses.asdict(made.scenes),
        "drawn_once_per_shard": "seeds and strengths of all effects, places of the electrodes, temperature and air "
        "pressure within those of the bench",
        "arrays": made.described,
        "mark": mark,
        **versions,
    }
    if made.file_format != "hdf5":  # which cards written before this entry have
        card["file_format"] = made.file_format
    return json.dumps(card, indent=2) + "\n"


def claim_folder(folder: Path, card: str) -> None:
    """Write the card into a folder without shards, or of shards that belong to it; it may have more frames than these.

    Raises:
        BenchError: the folder holds frames of another card, more frames, or other files.
    """
    path = folder / CARD
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = {name for name in os.listdir(folder) if not name.startswith(".")}
    except OSError as error:
        raise BenchError(f"{folder}: no folder can be made there ({error.strerror}); choose another") from error
    if names - {CARD} and CARD not in names:
        raise BenchError(f"{folder}: holds other files and no {CARD}; give an empty or a new folder")
    if CARD in names:
        old, new = _read_card(path), json.loads(card)
        differ = _differences(old, new)
        if differ and names != {CARD}:
            raise BenchError(f"{folder}: holds frames that differ in {differ}; give that command, or another folder")
        if old["frames"] > new["frames"] and names != {CARD}:
            raise BenchError(f"{folder}: holds {old['frames']:,} frames; give as many or more, or another folder")
    with replacing(path) as temporary:
        temporary.write_text(card, encoding="utf-8")


def _differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Names of the entries by which a card differs from that of a folder, besides the number of frames."""
    names = [name for name in {**new, **old} if name not in COUNTS and old.get(name) != new.get(name)]
    return ", ".join([name for name in names if name != "mark"] or names)


def _read_card(path: Path) -> dict[str, Any]:
    try:
        card: dict[str, Any] = json.loads(je.toml.read_text(path))
    except (ValueError, RecursionError) as error:
        raise BenchError(f"{path}: is no card of a data set ({error}); give another folder") from error
    types = {"frames": int, "arrays": dict, "mark": str}
    typed = isinstance(card, dict) and all(isinstance(card.get(name), kind) for name, kind in types.items())
    known = typed and card.get("format") == FORMAT and card.get("version") == FRAMES_VERSION
    if not known or card["frames"] < 1 or card.get("file_format", "hdf5") not in SHARDS:
        raise BenchError(f"{path}: is no card of {FORMAT} version {FRAMES_VERSION}; give another folder")
    return card


class TrainingFrames:
    """Frames for training that `calib.write_training_frames` has written; from `open_training_frames`.

    | attribute                                          |
    |----------------------------------------------------|
    | card: what the frames are, as a dictionary         |
    | shards: numbers of the shards that are read        |

    ``len`` is the number of frames. Each shard is another skin, so that `part` divides frames by skins: test a network
    on skins that it has not seen.
    """

    def __init__(self, folder: Path, card: Mapping[str, Any], shards: range):
        self.folder, self.card, self.shards = folder, card, shards

    def __len__(self) -> int:
        return sum(self._rows(number) for number in self.shards)

    def _rows(self, number: int) -> int:
        return _rows(int(self.card["frames"]), number)

    def part(self, start: float, stop: float) -> "TrainingFrames":
        """The shards from a share to another: ``part(0, 0.9)`` for training, ``part(0.9, 1)`` for a test.

        Raises:
            BenchError: if no shard is among them.
        """
        first, last = (round(share * len(self.shards)) for share in (start, stop))
        if not 0 <= first < last <= len(self.shards):
            raise BenchError(
                f"part({start:g}, {stop:g}) has none of {len(self.shards)} shards; give two shares from 0 to 1 further "
                "apart, or write more frames"
            )
        return TrainingFrames(self.folder, self.card, self.shards[first:last])

    def skins(self) -> Iterator["TrainingFrames"]:
        """The frames of one skin after another."""
        return (TrainingFrames(self.folder, self.card, range(number, number + 1)) for number in self.shards)

    def __getitem__(self, name: str) -> np.ndarray:
        """One array of all shards in memory, such as ``frames["force_map"]``, (frames, pixels).

        An array of the skins, such as ``untouched``, has one row for each shard.

        Raises:
            BenchError: for an unknown name, or an array beyond the budget of one in memory; see `batches`.
        """
        about = self._about(name)
        rows = len(self) if about["axes"][0] == "frame" else len(self.shards)
        nbytes = rows * int(np.prod(about["shape"][1:], dtype=int)) * np.dtype(about["dtype"]).itemsize
        require("array_bytes", nbytes, f"{self.folder}: {name}", BenchError)
        parts = [self._read(number, [name])[name] for number in self.shards]
        return np.concatenate(parts) if about["axes"][0] == "frame" else np.stack(parts)

    def batches(self, size: int, *names: str, seed: int | None = None) -> Iterator[tuple[np.ndarray, ...]]:
        """Batches of ``size`` frames, each a tuple of the arrays named; one pass over all frames.

        One shard is in memory at a time. With a seed, shards and the frames within each are in random order; the last
        frames of a shard, too few for a batch, are left out of this pass.

        Raises:
            BenchError: for an unknown name, an array without an axis of frames, or a size that no shard has.
        """
        largest = self._rows(self.shards[0])
        if not 1 <= size <= largest:
            raise BenchError(f"batches of {size} frames; give 1 to {largest}, those of a shard")
        for name in names:
            if self._about(name)["axes"][0] != "frame":
                raise BenchError(f"{name}: belongs to a shard and not to a frame; read it as frames[{name!r}]")
        return self._batches(size, names, None if seed is None else np.random.default_rng(seed))

    def _batches(
        self, size: int, names: tuple[str, ...], rng: np.random.Generator | None
    ) -> Iterator[tuple[np.ndarray, ...]]:
        shards = list(self.shards) if rng is None else rng.permutation(self.shards).tolist()
        for number in shards:
            arrays, rows = self._read(number, names), self._rows(number)
            order = np.arange(rows) if rng is None else rng.permutation(rows)
            for start in range(0, rows - size + 1, size):
                yield tuple(arrays[name][order[start : start + size]] for name in names)

    def _about(self, name: str) -> dict[str, Any]:
        if name not in self.card["arrays"]:
            raise BenchError(f"{name}: no such array; there are {', '.join(self.card['arrays'])}")
        about: dict[str, Any] = self.card["arrays"][name]
        return about

    def _read(self, number: int, names: Any) -> dict[str, np.ndarray]:
        for name in names:
            self._about(name)
        files = _shards_of(self.card)
        return files.read(files.path(self.folder, number), names, self.card["mark"], self._rows(number))


def _shards_of(card: Mapping[str, Any]) -> AbstractShards:
    return SHARDS[card.get("file_format", "hdf5")]


def open_training_frames(folder: str | os.PathLike[str]) -> TrainingFrames:
    """Open frames that `calib.write_training_frames` has written; arrays are read on request.

    Raises:
        BenchError: the folder has no card, or shards are missing because the writing was interrupted.
    """
    where = Path(folder)
    if not (where / CARD).is_file():
        raise BenchError(f"{where}: has no {CARD}; write frames with jaxeit simulate SCENE --random-scenes N -o FOLDER")
    card = _read_card(where / CARD)
    shards, files = range(-(-card["frames"] // SHARD_FRAMES)), _shards_of(card)
    missing = sum(not files.path(where, number).is_file() for number in shards)
    if missing:
        what = f"{missing} of {len(shards)} shards are missing"
        raise BenchError(f"{where}: {what}; the command that began them goes on from here")
    return TrainingFrames(where, card, shards)
