"""Kuopio Tomography Challenge 2023: untrained methods on phantoms of our own and on the challenge's training frames.

A water tank of 0.115 m radius with 32 electrodes around it, plastic and metal pieces in it (Räsänen et al. 2023). The
challenge has seven levels: level k takes the first 2 (k - 1) electrodes away, with every reading that uses one. Its
evaluation frames are not used here; the levels are made by leaving those readings out.

`phantoms` simulates the tank (`ktc_phantoms.py`): settings of methods are chosen on the set `tuning`, and `fresh` was
never looked at for that. `rows`, with ``--data``, is the last look: the four training frames. `bound` and
`outlines` ask what the readings tell of stars, crosses and crescents.
"""

from base64 import b64decode, b64encode
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from zlib import compress, decompress

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.io import loadmat
from scipy.optimize import minimize_scalar

import jaxeit as je

from .clock import seconds
from .figures import BLUE, ORANGE, panels
from .harness import Question, Run
from .ktc_bound import compared
from .ktc_outlines import outlined
from .ktc_phantoms import CONDUCTIVE, ELECTRODES, GRID, INSIDE, OBJECTS, RADIUS, RESISTIVE, WATER, Data, simulated
from .rows import Row, grouped

LEVELS, SMOKE_LEVELS = tuple(range(1, 8)), (1, 7)
PUBLISHED = {"linear baseline": 10.30, "winners (trained networks), about": 15.0}


def otsu_labels(image: np.ndarray) -> np.ndarray:
    """The challenge's own segmentation: three classes by Otsu's thresholds, the largest taken for water; what lies
    below it is resistive, what lies above conductive."""
    classes = np.digitize(image, np.asarray(je.metrics.otsu_thresholds(image)))
    water = np.bincount(classes.ravel()).argmax()
    return np.where(classes < water, RESISTIVE, np.where(classes > water, CONDUCTIVE, WATER))


# --- the challenge


def load(folder: Path) -> Data:
    """The training set from the challenge's MATLAB files."""
    reference = loadmat(folder / "training" / "ref.mat")
    drive, sense = reference["Injref"], reference["Mpat"].astype(float)
    drives, senses = (np.stack([p.argmax(0), p.argmin(0)], 1) for p in (drive, sense))
    count = len(senses)
    frames = [loadmat(folder / "training" / f"data{k}.mat")["Uel"].ravel() for k in range(1, 5)]
    truth = [loadmat(folder / "groundtruth_training" / f"true{k}.mat")["truth"] for k in range(1, 5)]
    pattern = np.concatenate([np.repeat(drives, count, 0), np.tile(senses, (len(drives), 1))], 1)
    return Data(pattern, float(drive.max(0).mean()), reference["Uelref"].ravel(), np.array(frames), np.array(truth))


def tank(data: Data, edge_length: float = 0.03) -> je.Model:
    """Our own mesh of the tank: electrode 0 at +y, counter-clockwise, half of the rim covered; 1 S and mA."""
    disc = je.Disc(RADIUS)
    patches = je.skin.rim_electrodes(disc, ELECTRODES, contact=1e-4, start=np.pi / 2)
    protocol = je.Protocol(data.pattern, data.current)
    return je.discretise(je.Scene(je.Skin("ktc", disc, 1.0, patches, protocol)), je.Fidelity(edge_length=edge_length))


class Water(NamedTuple):
    """Water as `ref.mat` tells it: sigma in mS, contact in kilohm m, what model (and offsets) miss of the
    readings (readings,) in V, and its norm relative to theirs."""

    sigma: float
    contact: float
    missed: np.ndarray
    residual: float


LEAST_CONTACT, MOST_CONTACT = 1e-6, 1.0  # contact resistance times conductivity, m; below, the mesh sees none


def homogeneous(model: je.Model, readings: np.ndarray, channel: np.ndarray | None = None) -> Water:
    """Fit of one conductivity and one contact resistance; with ``channel`` also of an offset of each sensing pair.

    All currents are taken alike: pairs that were driven in both directions then agree in size to 0.7 % on average, to
    2.6 % with the currents of the file. Most of what is left (7.3 % to 4.1 %) is a fixed offset of each sensing pair,
    which differences of frames do not see. As ``voltages(sigma, contact) = voltages(1, contact sigma) / sigma``, all
    but the product of the two is linear.
    """

    def less_offsets(values):
        if channel is None:
            return values
        return values - (np.bincount(channel, values) / np.bincount(channel))[channel]

    def fitted(ratio):
        unit = less_offsets(np.asarray(_even(model, jnp.asarray(ratio))))
        resistance = (unit @ readings) / (unit @ unit)
        return 1 / resistance, less_offsets(readings) - resistance * unit

    ends = np.log([LEAST_CONTACT, MOST_CONTACT])
    best = minimize_scalar(lambda log: np.linalg.norm(fitted(np.exp(log))[1]), bounds=ends, method="bounded")
    sigma, missed = fitted(np.exp(best.x))
    return Water(sigma, np.exp(best.x) / sigma, missed, float(np.linalg.norm(missed) / np.linalg.norm(readings)))


@eqx.filter_jit
def _even(model, ratio):
    """Readings of even water of unit conductivity."""
    contact = jnp.full_like(model.contact, 1 / ratio)
    return je.forward(eqx.tree_at(lambda m: m.contact, model, contact), jnp.ones_like(model.background))


def with_level(data: Data, level: int) -> Data:
    """Frames with NaN where a reading uses one of the first 2 (level - 1) electrodes."""
    lost = (data.pattern < 2 * (level - 1)).any(1)
    frames = np.where(lost, np.nan, data.frames)
    return replace(data, reference=np.where(lost, np.nan, data.reference), frames=frames)


def on_grid(values: np.ndarray, picture: Any) -> np.ndarray:
    """The challenge's 256 x 256 pixels, row 0 at +y, from those of an image by bilinear interpolation."""
    return np.where(INSIDE, je.imaging.on_grid(values, picture.picture, (GRID, GRID))[::-1], 0.0)


Method = Callable[[Data], list[np.ndarray]]  # frames to the labels of each


def linear(model: je.Model, image: je.model.BasisMap, water: Water, data: Data) -> list[np.ndarray]:
    """The recipe of the challenge: one step from even water with `Noser`, then Otsu."""
    sigma, used = jnp.full_like(model.background, water.sigma), jnp.asarray(np.isfinite(data.reference))
    recon = je.prepare(model, basis=image, hyperparameter=0.1, sigma=sigma, channels=used)
    images = np.asarray(recon(jnp.asarray(data.frames - data.reference)))
    return [otsu_labels(on_grid(image, recon)) for image in images]


def filled(model: je.Model, water: Water) -> je.Model:
    """The tank with water as the reference tells it."""
    values = jnp.full_like(model.background, water.sigma), jnp.full_like(model.contact, 1 / water.contact)
    return eqx.tree_at(lambda m: (m.background, m.contact), model, values)


def variation(model: je.Model, image: je.model.BasisMap, water: Water, data: Data, **settings: Any) -> list[np.ndarray]:
    """`je.imaging.segment` with its defaults or ``settings``, and water as the reference tells it."""
    model = filled(model, water)
    settings = {"missed": water.missed} | settings
    found = [je.imaging.segment(model, data.reference, frame, image, **settings) for frame in data.frames]
    return [np.where(INSIDE, one.classes[::-1], WATER) for one in found]


COLUMNS = {"linear": 40, "variation": 30}


def methods(model: je.Model, water: Water) -> dict[str, Method]:
    """The ways of this benchmark by name, each on its pixels."""
    ways = {way.__name__: way for way in (linear, variation)}
    return {name: partial(way, model, je.Pixels(COLUMNS[name]).on(model), water) for name, way in ways.items()}


# --- phantoms

SETS: dict[str, tuple[int, ...]] = {"tuning": (0, 1, 2), "fresh": (101, 102, 103)}  # seeds of the tanks of each set
SHOWN, SHOWN_LEVEL = ("crescent", "cross", "three"), 4  # of the first fresh tank


class Tank(NamedTuple):
    """Simulated frames, the methods that know its water, and the kind of each frame's phantom."""

    data: Data
    ways: dict[str, Method]
    kinds: tuple[str, ...]


def tanks(seeds: Sequence[int], kinds: tuple[str, ...] = tuple(OBJECTS)) -> list[Tank]:
    """Tanks by seed, inverted with the mesh of the challenge's."""
    all_data = [simulated(seed, kinds) for seed in seeds]
    model = tank(all_data[0])
    waters = [homogeneous(model, data.reference, data.channel) for data in all_data]
    return [Tank(data, methods(model, water), kinds) for data, water in zip(all_data, waters, strict=True)]


def found(one: Tank, method: str, level: int) -> list[Row]:
    """Kind, score, seconds and classes of each phantom of a tank."""
    data, rows = with_level(one.data, level), []
    for kind, frame, truth in zip(one.kinds, data.frames, data.truth, strict=True):
        spent, (classes,) = seconds(one.ways[method], replace(data, frames=frame[None]))
        score = float(je.metrics.ktc_score(classes, truth))
        rows.append({"kind": kind, "score": score, "seconds": spent, "classes": classes})
    return rows


def summary(rows: list[Row]) -> Row:
    """Mean score, mean score of each kind, median and largest seconds a frame."""
    by_kind = {
        kind: round(float(np.mean([r["score"] for r in some])), 3) for kind, some in grouped(rows, "kind").items()
    }
    times = [row["seconds"] for row in rows]
    mean = round(float(np.mean([row["score"] for row in rows])), 3)
    return {
        "mean": mean,
        "by_kind": by_kind,
        "seconds": round(float(np.median(times)), 2),
        "most_s": round(max(times), 2),
    }


def phantoms(run: Run) -> Iterator[Row]:
    """Both sets at all levels."""
    yield {"phantoms": [], "pictures": []}
    kinds = tuple(run.sizes(tuple(OBJECTS), ("crescent",)))
    for name, seeds in SETS.items():
        several = tanks(run.sizes(seeds, seeds[:1]), kinds)
        for level in run.sizes(LEVELS, SMOKE_LEVELS):
            by_method = {
                method: [r for one in several for r in found(one, method, level)] for method in several[0].ways
            }
            for method, rows in by_method.items():
                row = {"set": name, "level": level, "method": method} | summary(rows)
                print(row, flush=True)
                yield {"phantoms": [row], "phantoms_of_21": phantom_totals([*run.data["phantoms"], row])}
            if name == "fresh" and level == SHOWN_LEVEL:
                yield {"pictures": pictures(several[0], by_method)}


def phantom_totals(rows: list[Row]) -> Row:
    """Of 21 points, by set and method."""
    return {name: totals(mine) for name, mine in grouped(rows, "set").items()}


# --- what the readings tell of outlines

BOUND_KINDS, BOUND_LEVELS = ("star", "cross", "crescent"), (1, 4, 7)


def bound(run: Run) -> Iterator[Row]:
    """Fits from the true outline and from that of the image, for phantoms of the set `tuning`."""
    yield {"bound": []}
    for row in _each_shape(run, BOUND_KINDS, compared):
        yield {"bound": [row]}


def outlines(run: Run) -> Iterator[Row]:
    """Outlines of stars and crosses, which are functions of an angle, with errors in common."""
    yield {"outlines": []}
    for row in _each_shape(run, BOUND_KINDS[:2], outlined):
        yield {"outlines": [row]}


def _each_shape(run: Run, kinds: tuple[str, ...], question: Callable[..., Row]) -> Iterator[Row]:
    """The answer for each phantom of the kinds at each level."""
    seeds, asked = run.sizes(SETS["tuning"], SETS["tuning"][:1]), run.sizes(kinds, kinds[:1])
    all_data = [simulated(seed, BOUND_KINDS) for seed in seeds]
    model = tank(all_data[0])
    image = je.Pixels(COLUMNS["variation"]).on(model)
    for seed, data in zip(seeds, all_data, strict=True):
        water = homogeneous(model, data.reference, data.channel)
        for level in run.sizes(BOUND_LEVELS, SMOKE_LEVELS[1:]):
            for kind in asked:
                row = {"tank": seed, "kind": kind, "level": level}
                place = BOUND_KINDS.index(kind)
                row |= question(filled(model, water), image, water.missed, with_level(data, level), place)
                print(row, flush=True)
                yield row


# --- picture


def pictures(one: Tank, by_method: dict[str, list[Row]]) -> list[Row]:
    """Classes of the phantoms shown: truth, and by method with its score."""
    rows = []
    for kind in SHOWN:
        place = one.kinds.index(kind)
        classes = {"truth": packed(one.data.truth[place])}
        classes |= {method: packed(some[place]["classes"]) for method, some in by_method.items()}
        scores = {method: round(some[place]["score"], 2) for method, some in by_method.items()}
        rows.append({"kind": kind, "level": SHOWN_LEVEL, "classes": classes, "scores": scores})
    return rows


def packed(classes: np.ndarray) -> str:
    """Classes as a short text."""
    return b64encode(compress(classes.astype(np.uint8).tobytes(), 9)).decode()


def unpacked(text: str) -> np.ndarray:
    """Classes, (256, 256), of a text of `packed`."""
    return np.frombuffer(decompress(b64decode(text)), np.uint8).reshape(GRID, GRID)


COLOURS = ListedColormap(["#dfe9f2", ORANGE, BLUE])  # water, resistive, conductive
HEADS = {"truth": "truth", "linear": "linear", "variation": "je.imaging.segment"}


def picture(data: Row) -> Figure:
    """Truth and methods side by side, a row for each phantom."""
    rows = data["pictures"]
    figure, axes = panels(5.4, 1.9 * len(rows), len(rows), len(HEADS))
    for row, places in zip(rows, np.reshape(axes, (len(rows), len(HEADS))), strict=True):
        for place, (name, head) in zip(places, HEADS.items(), strict=True):
            shown = np.ma.masked_where(~INSIDE, unpacked(row["classes"][name]))
            place.imshow(shown, cmap=COLOURS, vmin=WATER, vmax=CONDUCTIVE)
            place.set_title(f"{head}: {row['scores'][name]:.2f}" if name in row["scores"] else row["kind"], fontsize=8)
            place.axis("off")
    return figure


# --- results


def scored(data: Data, ways: dict[str, Method], level: int) -> Iterator[Row]:
    """Scores of every method at a level."""
    for name, way in ways.items():
        spent, found = seconds(way, with_level(data, level))
        scores = [float(je.metrics.ktc_score(a, b)) for a, b in zip(found, data.truth, strict=True)]
        row: Row = {"level": level, "method": name, "seconds": round(spent, 2)}
        yield row | {"scores": np.round(scores, 3).tolist(), "mean": round(float(np.mean(scores)), 3)}


def totals(rows: list[Row]) -> dict[str, float]:
    """Mean over levels, of the 21 points of the challenge (three frames at each of seven levels)."""
    by_method = grouped(rows, "method")
    return {name: round(21 * float(np.mean([row["mean"] for row in mine])), 2) for name, mine in by_method.items()}


def challenge(run: Run) -> Iterator[Row]:
    """The training frames at all levels.

    Raises:
        SystemExit: without the folder of the challenge; a smoke run leaves the part out.
    """
    if run.args.data is None:
        if run.smoke:
            return
        raise SystemExit("give the folder of the challenge's training set, --data FOLDER, or --only phantoms")
    data = load(run.args.data)
    model = tank(data)
    ways = methods(model, homogeneous(model, data.reference, data.channel))
    if run.smoke:
        data = replace(data, frames=data.frames[:1], truth=data.truth[:1])
    yield {"published_of_21": PUBLISHED, "rows": []}
    for level in run.sizes(LEVELS, SMOKE_LEVELS):
        for row in scored(data, ways, level):
            print(row, flush=True)
            yield {"rows": [row], "of_21": totals([*run.data["rows"], row])}


DATA: Row = {"type": Path, "help": "folder with training/ and groundtruth_training/, for the part rows"}
PARTS = {"rows": challenge, "phantoms": phantoms, "bound": bound, "outlines": outlines}
main = Question("ktc", __doc__, PARTS, {"--data": DATA}, picture=picture, file="ktc-phantoms.png")

if __name__ == "__main__":
    main()
