"""Description of a simulated bench: a scene, the presses on it, and the streams that are recorded."""

import os
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

import jaxeit as je
from jaxeit.budget import require


class BenchError(ValueError):
    """A bench cannot be simulated as described.

    Example:
        try:
            replace(short, sites=np.array([[0.3, 0.1]]))  # m
        except calib.bench.BenchError as error:
            print(error)
    """


MAX_FORCE = 1e5  # N: more is another unit
RATE_TOLERANCE = 0.01  # by which frames may follow one another more quickly than a scan takes


@dataclass(frozen=True)
class Timing:
    """Timing of one press in seconds. The paper states 2 s of hold; the other times are assumed.

    | field    | meaning                                      |
    |----------|----------------------------------------------|
    | rest     | time without contact before the press        |
    | ramp     | time in which the force rises                |
    | hold     | time of constant force                       |
    | release  | time in which the force falls                |
    | recovery | time without contact after the press         |
    """

    rest: float = 1.0
    ramp: float = 1.0
    hold: float = 2.0
    release: float = 1.0
    recovery: float = 1.5

    @property
    def period(self) -> float:
        """Time in s from the start of one press to the start of the next."""
        return self.rest + self.ramp + self.hold + self.release + self.recovery


@dataclass(frozen=True)
class Companion:
    """A further tip at ``offset`` (2,) m from the first one, which presses with ``force`` N, ``delay`` s later.

    Example:
        # m, N: a tip that presses together with the first
        second = calib.bench.Companion(offset=(0.05, 0.0), force=8.0)
        two_tips = replace(short, sites=sites[:1], companions=(second,))
    """

    offset: tuple[float, float]
    force: float
    delay: float = 0.0


@dataclass(frozen=True, eq=False)
class Bench:
    """A scene, the presses on it, and the streams that are recorded.

    | field                                | meaning                                       | shape      | unit      |
    |--------------------------------------|-----------------------------------------------|------------|-----------|
    | scene                                | skin and effects                              |            |           |
    | sites                                | centres of the tip                            | (sites, 2) | m         |
    | forces                               | target forces, repeated over the sites        | (any,)     | N         |
    | tip_diameter                         | of all tips                                   | ()         | m         |
    | companions                           | further tips that press together with it      |            |           |
    | slide                                | displacement of all tips during the hold      | (2,)       | m         |
    | blank                                | time without contact at the start             | ()         | s         |
    | eit_rate, pad_rate                   | of EIT frames; of pressures and forces        | ()         | Hz        |
    | eit_step, pressure_step, force_step  | SI value of one stored count; eit_step None:  | ()         | V, Pa, N  |
    |                                      | twice the largest reading at rest is stored   |            |           |
    | temperature_rate, barometer_rate     | change of the surrounding air                 | ()         | K/s, Pa/s |
    | timing                               | of each press                                 |            |           |
    | seed                                 | of all random numbers                         |            |           |
    | title, epoch                         | of the session; when its clock reads zero     |            |           |
    | toml                                 | the scene file as text                        |            |           |

    Raises:
        BenchError: for a tip that would leave the sheet or is wider than it, forces that do not press, and rates at
            which nothing can be recorded.

    Example:
        print(f"{len(bench.sites)} presses to {bench.press_forces.max():.0f} N in {bench.duration:.0f} s")
        print([type(effect).__name__ for effect in bench.scene.effects])
    """

    scene: je.Scene
    sites: np.ndarray
    forces: np.ndarray
    title: str = "simulated bench session"
    tip_diameter: float = 0.02
    companions: tuple[Companion, ...] = ()
    slide: tuple[float, float] = (0.0, 0.0)
    timing: Timing = field(default_factory=Timing)
    blank: float = 60.0
    eit_rate: float = 180.0
    pad_rate: float = 200.0
    eit_step: float | None = None
    pressure_step: float = 1.0
    force_step: float = 0.01
    temperature_rate: float = 0.0
    barometer_rate: float = 0.0
    seed: int = 0
    epoch: datetime = datetime(2026, 1, 1, tzinfo=UTC)
    toml: str = ""

    def __post_init__(self) -> None:
        self._require_possible()
        for name, offset in (("", (0.0, 0.0)), *((" of a companion", c.offset) for c in self.companions)):
            for way, moved in (("", (0.0, 0.0)), (", after its slide,", self.slide)):
                places = self.sites + np.add(offset, moved)
                outside = ~self.scene.skin.domain.contains(places)
                if outside.any():
                    number = int(np.argmax(outside))
                    x, y = places[number]
                    where = f"site {number}{name}{way} at ({x:g}, {y:g}) m lies outside the sheet"
                    raise BenchError(f"{where}; give sites = [[x, y], ...] in m on the sheet, from its origin")

    def _require_possible(self) -> None:
        forces, (low, high) = np.asarray(self.forces), np.asarray(self.scene.skin.domain.bounds)
        pressed = (forces > 0) & (forces <= MAX_FORCE)
        if not pressed.all() or (len(self.sites) and not len(forces)):
            raise BenchError(f"forces are {forces.tolist()} N; give one or more, above 0 up to {MAX_FORCE:g}")
        if self.tip_diameter > (high - low).min():
            raise BenchError(f"a tip of {self.tip_diameter:g} m is wider than the sheet; give its diameter in m")
        scan = self.scene.skin.protocol.frame_time
        if self.eit_rate * scan > 1 + RATE_TOLERANCE:
            raise BenchError(
                f"eit_rate is {self.eit_rate:g} Hz, but a scan of this skin takes {scan:.3g} s; give at most "
                f"{1 / scan:.4g} Hz, or shorten reading_time in the skin's file"
            )
        for name, rate in (("eit_rate", self.eit_rate), ("pad_rate", self.pad_rate)):
            if self.blank * rate < 1 or self.timing.hold * rate < 1:
                raise BenchError(f"{name} is {rate:g} Hz: no sample in the blank or in a hold; raise it")

    @property
    def period(self) -> float:
        """Time in s from the start of one press to the start of the next."""
        return self.timing.period + max((c.delay for c in self.companions), default=0.0)

    @property
    def duration(self) -> float:
        """Duration of the whole recording, s."""
        return self.blank + len(self.sites) * self.period

    @property
    def press_forces(self) -> np.ndarray:
        """Target force of each press (sites,) N."""
        return np.resize(self.forces, len(self.sites))


def load_bench(path: str | Path) -> Bench:
    """Load a bench from a scene file, or a shipped preset by its name (see `presets`).

    The path of the skin in a scene file starts at the folder of the scene, or else at the working directory.

    Raises:
        ValueError: naming the file, the key and the reason.
    """
    path = str(path)
    if path in presets() and not Path(path).exists():
        text = (SCENE_FOLDER / f"{path}.toml").read_text(encoding="utf-8")
    elif not path.endswith(".toml") and not Path(path).exists():
        hint = f"did you mean {path}.toml?" if Path(f"{path}.toml").exists() else f"presets: {', '.join(presets())}"
        raise BenchError(f"{path}: no such scene file or preset; {hint}")
    else:
        text = je.toml.read_text(Path(path))
    return je.toml.parse_toml(text, path, lambda table: _bench(table, text, Path(path).parent), allow_import=True)


SCENE_FOLDER = resources.files(__package__) / "scenes"


def presets() -> tuple[str, ...]:
    """Names of the shipped scenes."""
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in SCENE_FOLDER.iterdir() if entry.name.endswith(".toml"))
    )


def _bench(top: je.toml.TomlTable, text: str, folder: Path) -> Bench:
    top.choice("format", "jaxeit-scene")
    top.get("version", lambda v: v == 1, "1, the version this jaxeit reads")
    skin = _skin(top.get("skin", lambda v: isinstance(v, str), "a skin's name or path"), folder)
    title = top.get("title", lambda v: isinstance(v, str), "the session's title")
    seed = top.get("seed", lambda v: type(v) is int and 0 <= v < 2**31, "a whole number")
    effects = je.model.read_effects(top)
    table = top.table("bench")
    top.done()
    names = ("blank", "eit_rate", "pad_rate", "eit_step", "pressure_step", "force_step")
    numbers: dict[str, Any] = {n: table.positive(n, "a number") for n in names if table.has(n)}
    if table.has("tip_diameter"):
        numbers["tip_diameter"] = table.positive("tip_diameter", "a length in m")
    if table.has("slide"):
        numbers["slide"] = table.vector("slide", 2, "[dx, dy] in m, moved during the hold")
    for name in ("temperature_rate", "barometer_rate"):
        if table.has(name):
            numbers[name] = table.number(name, "a rate per second", least=float("-inf"))
    numbers["companions"] = tuple(_companion(entry) for entry in table.tables("companions"))
    forces = table.array("forces", None, "[N, ...], target forces of the presses")
    sites = _sites(table, skin.domain)
    times = [n for n in Timing.__dataclass_fields__ if table.has(n)]
    timing = Timing(**{n: table.positive(n, "s") for n in times})
    table.done()
    scene = je.Scene(skin, effects)
    return Bench(scene, sites, forces, title, timing=timing, seed=seed, toml=text, **numbers)


def _skin(name_or_path: str, folder: Path) -> je.Skin:
    """A skin by its path from the scene's folder, by its path from the working directory, or by a shipped name."""
    beside = folder / name_or_path
    return je.load_skin(beside if os.path.isfile(beside) else name_or_path)


def _sites(table: je.toml.TomlTable, domain: je.geometry.Domain) -> np.ndarray:
    if table.has("sites"):
        return table.array("sites", 2, "[[x, y], ...] in m")
    columns, rows = table.count("columns"), table.count("rows")
    require("sites", columns * rows, table.where, je.toml.TomlError)
    margin = table.number("margin", "least distance of the tip's centre from the rim, m")
    (x0, y0), (x1, y1) = domain.bounds
    if 2 * margin > min(x1 - x0, y1 - y0):
        what = f"is {margin:g} m, which leaves no place on a sheet of {x1 - x0:g} x {y1 - y0:g} m"
        raise table.error("margin", f"{what}; give less than half of its shorter side, in m")
    x = np.linspace(x0 + margin, x1 - margin, columns)
    y = np.linspace(y0 + margin, y1 - margin, rows)
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    # the grid fills the bounding box, in whose corners a disc or a polygon has no sheet
    kept = domain.contains(places) & (domain.boundary_distance(places) >= margin - domain.tolerance)
    if not kept.any():
        raise table.error(
            "margin", f"is {margin:g} m, and no place of the {columns} x {rows} grid is so far inside the sheet"
        )
    return places[kept]


def _companion(table: je.toml.TomlTable) -> Companion:
    offset = table.vector("offset", 2, "[dx, dy] in m, from the first tip")
    force, delay = table.positive("force", "N"), table.number("delay", "s", 0.0)
    table.done()
    return Companion((offset[0], offset[1]), force, delay)
