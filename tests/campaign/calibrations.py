"""Lies of calibrations: well-formed archives whose numbers were changed, told to `apply`."""

from pathlib import Path

import numpy as np

from calib.session import read_archive, write_archive

from .honest import Honest
from .telling import Verdict, same

Random = np.random.Generator
POWERS = (1e-9, 1e-6, 1e-3, 1e-2, 1e2, 1e3, 1e6, 1e9)  # a factor of ten is within what skins differ by


def _everywhere(array: np.ndarray, rng: Random) -> np.ndarray:
    return np.ones(array.shape, bool)


def _one(array: np.ndarray, rng: Random) -> np.ndarray:
    mask = np.zeros(array.shape, bool)
    mask.flat[int(rng.integers(array.size))] = True
    return mask


def _changed(array: np.ndarray, rng: Random) -> tuple[np.ndarray, str]:
    """Another array of the same shape and type."""
    where, part = ((_everywhere, "all"), (_one, "one"))[int(rng.integers(2))]
    mask, kind = where(array, rng), int(rng.integers(5))
    if array.dtype.kind != "f":
        moved = array[::-1] if kind % 2 else np.roll(array, 1, 0)
        return np.ascontiguousarray(moved), "in another order"
    if kind == 0:
        return np.where(mask, -array, array), f"sign of {part}"
    if kind == 1:
        factor = POWERS[int(rng.integers(len(POWERS)))]
        return np.where(mask, factor * array, array).astype(array.dtype), f"{part} times {factor:g}"
    if kind == 2:
        bad = (np.nan, np.inf, -np.inf)[int(rng.integers(3))]
        return np.where(mask, bad, array).astype(array.dtype), f"{part} {bad}"
    if kind == 3:
        return np.ascontiguousarray(array[::-1]), "in falling order"
    return array[rng.permutation(len(array))], "shuffled"


def _spoken(attrs: dict, rng: Random) -> str:
    """Another word in the place of one."""
    others = {
        "provenance_curve": ("power", "affine", "play"),
        "provenance_location": ("edge", "constant"),
        "image_rows": (20, 5),
        "image_columns": (20, 5),
    }
    name = list(others)[int(rng.integers(len(others)))]
    attrs[name] = others[name][int(rng.integers(len(others[name])))]
    return f"{name} {attrs[name]}"


def lie(rng: Random, honest: Honest, folder: Path) -> tuple[str, Verdict]:
    """Change one array or one word; `apply` to the short recording."""
    archive = read_archive(honest.folder / "c.h5", "skin-calibration")
    own = {"format", "format_version", "Conventions", "complete"}
    attrs = {k: v for k, v in archive.attrs.items() if k not in own}
    arrays = dict(archive.arrays)
    if rng.random() < 0.05:
        name = _spoken(attrs, rng)
    else:
        names = [n for n in arrays if arrays[n].size and arrays[n].ndim and arrays[n].dtype.kind in "fiub"]
        used = [n for n in names if n.startswith(("image/", "pads/"))]
        chosen = used if rng.random() < 0.8 else names
        at = chosen[int(rng.integers(len(chosen)))]
        arrays[at], what = _changed(arrays[at], rng)
        name = f"{at} {what}"
    path = folder / "lie.h5"
    write_archive(path, "skin-calibration", attrs, {
        k: (v, archive.units[k], archive.long_names[k]) for k, v in arrays.items()
    })  # fmt: skip
    return name, _applied(honest, path)


def _applied(honest: Honest, path: Path) -> Verdict:
    maps, answer = honest.force_maps(path, honest.folder / "short.h5")
    if answer.refused:
        return Verdict("refused", answer.err)
    if answer.err or "note" in answer.out:
        return Verdict("said", answer.err or answer.out)
    true = honest.short_maps
    valid = np.asarray(maps["pad_valid"], bool)
    forces = np.where(valid, maps["pad_force"], np.nan)
    wrong = [] if same(forces, true["pad_force"]) else ["pad_force"]
    wrong += [n for n in ("force", "force_se", "pad_force_se", "centres", "areas") if not same(maps[n], true[n])]
    if wrong and not valid[np.asarray(true["pad_valid"], bool)].any():
        return Verdict("said", "no force is declared valid")
    if wrong:
        return Verdict("SILENT", f"no word, and {', '.join(wrong)} differ")
    return Verdict("harmless" if (valid == np.asarray(true["pad_valid"], bool)).all() else "said")
