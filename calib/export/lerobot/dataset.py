"""Force maps as a LeRobot dataset: each force map is an episode, at a constant rate."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxeit.notebook import png_of

from ...calibration.application.frame_blocks import Progress
from ...calibration.application.map_files import FORCE_MAP_FORMAT
from ...session import ArchiveReader, open_archive
from ...session.argument_checks import paths_of
from ...session.errors import problem
from ...session.outputs import folder_beside
from ..errors import ExportError
from .files import DEFAULT_FEATURES, FrameFiles, info_of, write_metadata
from .stats import FeatureStats, Stats, aggregated, flat

BLOCK = 256  # frames that are written at once
ROBOT = "jaxeit_skin"
STATE, VALID, MAP, IMAGE, AGE = (
    f"observation.{name}" for name in ("state", "pad_valid", "force_map", "images.skin", "frame_age")
)
MAX_REPEATS = 10  # of each force map, by a rate of frames above its own
MAX_STRETCH = 100  # of a recording by gaps, which become repeated frames
SECOND = 10**9  # ns
LONGEST_ARC = 0.4  # of a period, within which force maps that come once a period arrive
PROMPT_SHARE = 0.98  # of the force maps; the others may be later
ROUND_SCALES = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class DatasetSummary:
    """What a LeRobot dataset holds.

    | meaning                                                | unit |
    |--------------------------------------------------------|------|
    | episodes, frames                                       |      |
    | fps: rate of the frames                                | Hz   |
    | full_scale: force on a pixel that is white in an image | N    |
    """

    episodes: int
    frames: int
    fps: int
    full_scale: float

    def __str__(self) -> str:
        return (
            f"{self.episodes} episode{'s' * (self.episodes != 1)}, {self.frames:,} frames at {self.fps} Hz; "
            f"white in an image is {self.full_scale:g} N on a pixel"
        )


def export_lerobot(
    sources: Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    task: str = "touch the skin",
    fps: int | None = None,
    full_scale: float | None = None,
    progress: Progress = iter,
) -> DatasetSummary:
    """Write force maps of `calib.apply` as a LeRobot dataset of version 3.0; it appears only when complete.

    ``docs/lerobot.md`` lists the features. Each source is an episode. Its frames are due at even distances of 1 / fps,
    and each is the last force map that had arrived by then. At the rate of the force maps the frames are due just after
    these arrive, early and late ones alike, so that none is repeated or left out.

    Args:
        output: a folder that does not exist.
        task: what was done, in words.
        fps: frames a second; default: the lowest rate of the force maps, rounded.
        full_scale: force on a pixel that is white in an image, N; default: the largest one, rounded up to 1, 2 or 5.
        progress: wraps what is written piece by piece, as `tqdm.tqdm` does.

    Raises:
        SessionError: for another kind of file, or one without frames.
        ExportError: if the force maps are of different skins, an option is out of range, or the output exists.
        ImportError: without the library `pyarrow`, of the extra ``tables``.
    """
    output, paths = Path(output), paths_of(sources, "export_lerobot", ExportError)
    _require(paths, output, fps, full_scale)
    skins = _skins_of(paths)
    _require_few_repeats(fps, max(skin.rate for skin in skins))
    fps = fps or max(1, round(min(skin.rate for skin in skins)))
    full_scale = full_scale or rounded_up(max(skin.largest for skin in skins))
    with folder_beside(output) as temporary:
        folder = temporary / output.name
        folder.mkdir()
        features = features_of(skins[0].rows, skins[0].columns, list(skins[0].pads), full_scale)
        episodes, stats = _write_frames(paths, folder, features, fps, full_scale, task, progress)
        frames = sum(row["length"] for row in episodes)
        info = info_of(features, fps, len(episodes), frames, ROBOT)
        write_metadata(folder, info, flat(stats), episodes, task)
        os.rename(folder, output)
    return DatasetSummary(len(episodes), frames, fps, full_scale)


class _Source(NamedTuple):
    """What a force map says before its frames are read: rate of the frames (Hz), largest force on a pixel (N), name."""

    rows: int
    columns: int
    pads: tuple[str, ...]
    rate: float
    largest: float
    skin: str

    def __str__(self) -> str:
        return f"{self.skin}, image {self.rows} x {self.columns}, {len(self.pads)} pads"


def _require(sources: Sequence[object], output: Path, fps: int | None, full_scale: float | None) -> None:
    if not sources:
        raise ExportError("lerobot: no force map; name one or more, each of which becomes an episode")
    if output.exists():
        raise ExportError(f"{output}: exists; name another folder, or remove it first")
    if (fps is not None and fps < 1) or (full_scale is not None and not 0 < full_scale < np.inf):
        raise ExportError("lerobot: --fps is a whole number from 1 on, and --full-scale a force above zero, N")


def _require_few_repeats(fps: int | None, rate: float) -> None:
    """Refuse a rate of frames at which most of them would be copies of the force map before, in Hz."""
    if fps is not None and fps > (most := max(1, round(MAX_REPEATS * rate))):
        raise ExportError(
            f"lerobot: --fps {fps} would repeat each force map {fps / rate:,.3g} times, which come at {rate:.3g} Hz; "
            f"give {most} or less"
        )


def _skins_of(sources: list[Path]) -> list[_Source]:
    """What `_skin_of` tells of each force map; all must be of one skin."""
    skins = [_skin_of(source) for source in sources]
    for source, skin in zip(sources, skins, strict=True):
        if skin[:3] != skins[0][:3]:
            raise ExportError(
                f"{source}: another skin than that of {sources[0]} ({skin} and {skins[0]}); export it alone"
            )
    return skins


def features_of(rows: int, columns: int, pads: list[str], full_scale: float) -> dict[str, dict[str, Any]]:
    """The features of a dataset, as ``meta/info.json`` states them."""
    number = {"dtype": "float32", "shape": [1], "names": None}
    picture = {"dtype": "image", "shape": [rows, columns, 3], "names": ["height", "width", "channels"]}
    return {
        STATE: number | {"shape": [len(pads)], "names": pads},
        VALID: {"dtype": "bool", "shape": [len(pads)], "names": pads},
        MAP: number | {"shape": [rows, columns], "names": ["height", "width"]},
        IMAGE: picture | {"info": {"is_depth_map": False, "newtons_of_255": full_scale}},
        AGE: number,
        **DEFAULT_FEATURES,
    }


def grey_images(maps: np.ndarray, full_scale: float) -> np.ndarray:
    """Maps (n, rows, columns) N as grey values uint8: 255 is the full scale, and what is not known is 0."""
    part = np.clip(np.nan_to_num(maps, nan=0.0) / full_scale, 0, 1)
    grey: np.ndarray = np.rint(255 * part).astype(np.uint8)
    return grey


def rounded_up(value: float) -> float:
    """The next number of the form 1, 2 or 5 times a power of ten; 1 for zero."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(min(scale * power for scale in ROUND_SCALES if scale * power >= value * (1 - 1e-9)))


def _skin_of(path: Path) -> _Source:
    """What a force map says; raises `SessionError` for a file that is none, or without frames."""
    with open_archive(path, FORCE_MAP_FORMAT) as archive:
        rows, columns = (archive.attrs.get(name) for name in ("image_rows", "image_columns"))
        names = ("time", "force", "pad_force", "pad_valid", "pad_names")
        missing = next((name for name in names if name not in archive.arrays), "")
        if missing or not isinstance(rows, int) or not isinstance(columns, int):
            raise problem(path, missing or "image_rows", "missing", "write the force map again with `jaxeit apply`")
        frames, pixels = archive.arrays["force"].shape
        times = archive.arrays["time"].read()
        if pixels != rows * columns or frames != len(times):
            raise problem(path, "force", "has another shape than time and image", "write the force map again")
        if frames < 1:
            raise problem(path, "time", "holds no frame", "apply the calibration to a longer session")
        rate = _rate(path, times)
        blocks = (archive.arrays["force"].read(at, at + BLOCK) for at in range(0, frames, BLOCK))
        largest = max(float(np.nanmax(block, initial=0.0)) for block in blocks)
        pads = tuple(str(name) for name in archive.arrays["pad_names"].read().tolist())
        return _Source(rows, columns, pads, rate, largest, str(archive.attrs.get("skin", "a skin without a name")))


def _rate(path: Path, times: np.ndarray) -> float:
    """The rate of frames with times in ns, Hz."""
    steps = np.diff(times)
    if not len(steps):
        return 1.0
    if (steps <= 0).any() or times[-1] - times[0] > MAX_STRETCH * len(steps) * np.median(steps):
        raise problem(path, "time", "is not in order, or has long gaps", "cut the session, and apply the calibration")
    return 1e9 / float(np.median(steps))


def _write_frames(
    sources: list[Path],
    folder: Path,
    features: dict[str, dict[str, Any]],
    fps: int,
    full_scale: float,
    task: str,
    progress: Progress,
) -> tuple[list[dict[str, Any]], dict[str, Stats]]:
    """Write the frames of all episodes; returns the rows of the table of episodes, and statistics of all."""
    episodes: list[dict[str, Any]] = []
    every: list[dict[str, Stats]] = []
    first = 0
    with FrameFiles(folder, features) as files:
        for number, source in enumerate(progress(sources)):
            with open_archive(source, FORCE_MAP_FORMAT) as archive:
                times = archive.arrays["time"].read()
                due = due_times(times, fps)
                rows = held_rows(times, fps, due)
                ages = np.arange(len(rows)) / fps + (due.delay - (times[rows] - times[0])) / SECOND
                stats = {name: FeatureStats(len(rows), channels=name == IMAGE) for name in features}
                place = files.begin_episode()
                for columns in _blocks(archive, ages, rows, fps, full_scale, first, number, features[MAP]["shape"]):
                    for name, part in stats.items():
                        part.add(columns[name] / 255 if name == IMAGE else columns[name])
                    pictures = [png_of(np.repeat(grey[..., None], 3, -1)) for grey in columns[IMAGE]]
                    files.append(columns | {IMAGE: pictures})
            every.append({name: part.result() for name, part in stats.items()})
            last = first + len(rows)
            row = {"episode_index": number, "tasks": [task], "length": len(rows)} | place
            row |= {"dataset_from_index": first, "dataset_to_index": last}
            episodes.append(row | flat(every[-1], "stats/"))
            first = last
    return episodes, {name: aggregated([one[name] for one in every]) for name in features}


class DueTimes(NamedTuple):
    """When the frames of an episode are due: ``delay`` after its first force map, and at even distances from there."""

    frames: int
    delay: int  # ns


def due_times(times: np.ndarray, fps: int) -> DueTimes:
    """Due times for force maps with times in ns, such that equal rates give one frame for each force map.

    Force maps that come once a period arrive at nearly the same part of it, early and late ones within a short arc of
    that circle. The frames are due at the end of the arc; where there is none, from the first force map on.
    """
    parts = np.sort((times - times[0]) * fps % SECOND)  # of a period, in units of 1e-9
    circle = np.append(parts, parts + SECOND)
    counts = np.searchsorted(circle, parts + int(LONGEST_ARC * SECOND), "left") - np.arange(len(parts))
    start = int(np.argmax(counts))
    slack, delay = fps, 0  # one ns: times are rounded
    if counts[start] >= PROMPT_SHARE * len(parts):
        end = int(circle[start + counts[start] - 1])
        slack, delay = end - int(parts[start]) + fps, -(-(end % SECOND) // fps)
    return DueTimes(int(((times[-1] - times[0]) * fps + slack) // SECOND) + 1, delay)


def held_rows(times: np.ndarray, fps: int, due: DueTimes) -> np.ndarray:
    """Rows of the force maps, with times in ns, that are the last to have arrived when each frame is due.

    A force map one ns late is in time: both times are rounded.
    """
    at = times[0] + due.delay + (np.arange(due.frames) * SECOND) // fps
    rows: np.ndarray = np.searchsorted(times, at + 1, "right") - 1
    return rows


def _blocks(
    archive: ArchiveReader,
    ages: np.ndarray,
    rows: np.ndarray,
    fps: int,
    full_scale: float,
    first: int,
    episode: int,
    shape: list[int],
) -> Iterator[dict[str, Any]]:
    """Columns of frames, block by block; images as grey values."""
    arrays = archive.arrays
    for start in range(0, len(rows), BLOCK):
        chosen = rows[start : start + BLOCK]
        low, high, count = int(chosen[0]), int(chosen[-1]) + 1, len(chosen)
        force, pads, valid = (
            arrays[name].read(low, high)[chosen - low] for name in ("force", "pad_force", "pad_valid")
        )
        number = np.arange(start, start + count)
        # The lowest row of the map has the smallest y; pictures have +y upwards, as those of ROS.
        maps = force.reshape(count, *shape)[:, ::-1]
        yield {
            STATE: pads.astype(np.float32),
            VALID: valid > 0,
            MAP: np.ascontiguousarray(maps, np.float32),
            IMAGE: grey_images(maps, full_scale),
            AGE: np.maximum(ages[number], 0).astype(np.float32),
            "timestamp": (number / fps).astype(np.float32),
            "frame_index": number,
            "episode_index": np.full(count, episode),
            "index": first + number,
            "task_index": np.zeros(count, int),
        }
