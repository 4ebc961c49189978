"""Lies of skins and scenes: numbers scaled by powers of ten, exchanged or turned round; names exchanged."""

import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import calib
import jaxeit as je
from calib.bench import load_bench
from calib.check import transfer_matrix
from calib.check.eit.reading_order import predict_readings

from .honest import Honest
from .telling import Verdict, judged, same, tell

Random = np.random.Generator
NUMBER = re.compile(r"(?<![\w.\"-])-?\d+\.?\d*(?:e-?\d+)?(?![\w.\"])")
SIGNED = (  # numbers of a scene that may be below zero
    "coefficient", "gain", "skew", "offset", "nonlinearity", "lowest", "highest", "temperature_rate", "barometer_rate",
)  # fmt: skip
UNSEEN = ("version", "minimum", "maximum", "accuracy", "frequency", "reading_time")  # no reading depends on them
TOLERANCE = 0.1  # of the rms reading: what the sheet and the electrodes of an honest skin scatter


def lie(rng: Random, honest: Honest, folder: Path) -> tuple[str, Verdict]:
    """A skin, told to `check` with an honest recording; or a scene, told to the reader of `simulate`."""
    return skin(rng, honest, folder) if rng.random() < 0.75 else scene(rng, folder)


def _edited(rng: Random, text: str) -> tuple[str, str]:
    """A text with one number changed or two exchanged, and what was done."""
    lines = text.splitlines()
    places = [
        (i, m) for i, line in enumerate(lines) for m in NUMBER.finditer(line) if line.split(" =")[0] not in UNSEEN
    ]
    at, found = places[int(rng.integers(len(places)))]
    if rng.random() < 0.2:
        other, second = places[int(rng.integers(len(places)))]
        changes = [(at, found, second[0]), (other, second, found[0])] if (other, second) != (at, found) else []
    else:
        power = int(rng.choice([-6, -3, -2, -1, 1, 2, 3, 6]))
        factor = -1.0 if rng.random() < 0.25 else 10.0**power
        new = float(found[0]) * factor + 0.0  # of zero, no sign
        word = str(int(new)) if re.fullmatch(r"-?\d+", found[0]) and new == int(new) else repr(new)
        changes = [(at, found, word)]
    for i, match, word in sorted(changes, key=lambda c: -c[1].start()):  # from the end of a line to its start
        lines[i] = lines[i][: match.start()] + word + lines[i][match.end() :]
    said = "; ".join(f"line {i}: {lines[i].strip()}" for i in sorted({c[0] for c in changes}))
    return "\n".join(lines) + "\n", said


def _renamed(rng: Random, text: str) -> tuple[str, str]:
    """The rectangles of two pads exchanged, or electrodes counted in rows instead of along a snake."""
    if rng.random() < 0.3:
        return text.replace('order = "snake"', 'order = "rows"'), "electrodes in rows"
    boxes = re.findall(r"rectangle = .*", text)
    a, b = rng.choice(len(boxes), 2, replace=False)
    new = text.replace(boxes[a], "#").replace(boxes[b], boxes[a]).replace("#", boxes[b])
    return new, f"pads {a} and {b} exchanged"


def skin(rng: Random, honest: Honest, folder: Path) -> tuple[str, Verdict]:
    """Told to `check`; if nothing is said, the readings, the current and the pads that it predicts are compared."""
    text = (honest.folder / "small.toml").read_text()
    new, name = (_edited if rng.random() < 0.85 else _renamed)(rng, text)
    path, session, words = folder / "lie.toml", honest.folder / "short.h5", ("--skin", folder / "lie.toml")
    path.write_text(new)
    if rng.random() < 0.6:  # the session itself describes this skin: no other description contradicts it
        own = replace(honest.recording, facts=replace(honest.recording.facts, skin_toml=new))
        session, words, name = own.write(folder / "lie.h5"), (), f"in the session, {name}"
    verdict = judged(tell("check", session, *words, "--json"))
    return f"skin: {name}", verdict or _predicted(honest, je.load_skin(path))


def _predicted(honest: Honest, found: je.Skin) -> Verdict:
    own, pattern = honest.skin, honest.recording.facts.pattern
    true, readings = (predict_readings(t, pattern) for t in (honest.transfer, transfer_matrix(found)))
    wrong = float(np.sqrt(np.mean((readings - true) ** 2) / np.mean(true**2)))
    if wrong > TOLERANCE:
        return Verdict("SILENT", f"no word, and readings differ by {100 * wrong:.0f} %")
    if len(found.pads) != len(own.pads) or not all(
        same(a.outline, b.outline) for a, b in zip(found.pads, own.pads, strict=True)
    ):
        return Verdict("SILENT", "no word, and pads differ")
    return Verdict("harmless")


def scene(rng: Random, folder: Path) -> tuple[str, Verdict]:
    """Read as `simulate` does: what is accepted is what is written, not ignored, nor below zero where none can be."""
    scenes = sorted((Path(calib.__file__).parent / "bench" / "scenes").glob("*.toml"))
    text = scenes[int(rng.integers(len(scenes)))].read_text()
    text = "\n".join(line.split(" #")[0].rstrip() for line in text.splitlines() if not line.startswith("#")) + "\n"
    new, name = _edited(rng, text)
    path, original = folder / "lie.toml", folder / "honest.toml"
    path.write_text(new)
    original.write_text(text)
    return f"scene: {name}", _loaded(path, original, name)


def _loaded(path: Path, original: Path, name: str) -> Verdict:
    try:
        bench = load_bench(path)
    except ValueError:
        return Verdict("refused", tell("simulate", path, "-o", path.with_suffix(".h5")).err)
    below = re.search(r"\b(\w+) = -(?!0)", name)
    if below and below[1] not in SIGNED:
        return Verdict("SILENT", f"{below[1]} below zero is accepted")
    ignored = path.read_text() != original.read_text() and _numbers(bench) == _numbers(load_bench(original))
    return Verdict("SILENT", "the number is ignored") if ignored else Verdict("harmless", "as it is written")


def _numbers(part: Any) -> Any:
    """What a bench holds, as lists, but for its text."""
    if is_dataclass(part):
        return [_numbers(getattr(part, f.name)) for f in fields(part) if f.name != "toml"]
    if isinstance(part, list | tuple):
        return [_numbers(p) for p in part]
    return np.asarray(part).tolist() if isinstance(part, np.ndarray | jax.Array) else repr(part)
