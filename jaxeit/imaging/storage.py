"""A reconstructor as numbers, so that a robot applies it without mesh or solver.

Numbers, not a compiled program: those fail, or worse load and differ, under another version of JAX.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compile import require_known
from ..array_files import DAMAGE, read_arrays, write_arrays
from ..linalg import is_covariance
from ..model.bases import Picture
from .methods import AbstractIterativeMethod, Problem
from .readings.whitening import Whitening, lines_of, lines_of_shares
from .reconstruction import IterativeReconstructor, Provenance, Reconstructor
from .settings import Imaging

FORMAT = "jaxeit reconstructor 1"

# Name: dimensions, unit, meaning.
_SHARED = {
    "predict": ("k k", "ohm2", "pair sums of the one-step image, from weighted sums of the readings"),
    "pairs": ("readings n", "1", "the pair sums of each reading: four, or as many as shares has"),
    "current": ("", "A", "amplitude of the stimulation"),
    "weight": ("readings *", "1/V2", "inverse of the noise: variances, or a covariance matrix"),
    "channels": ("readings", "1", "readings that are used"),
    "centres": ("basis 2", "m", "centres of the pixels"),
    "areas": ("basis", "m2", "areas of the pixels on the sheet"),
    "edges": ("edges 2", "1", "pairs of neighbouring pixels"),
    "edge_length": ("edges", "m", "length of the border that neighbours share"),
}
LINEAR_NUMBERS = {
    "factor": ("basis k", "S ohm", "image per weighted sum of the readings, in A/V"),
    "variance": ("basis", "S2", "variance left to each coefficient"),
    **_SHARED,
}
ITERATIVE_NUMBERS = {
    "compress": ("r k", "ohm", "whitened readings, from weighted sums of the readings"),
    "jacobian": ("r basis", "1/S", "of the whitened readings"),
    "count": ("", "1", "readings that the whitened ones stand for"),
    "hyperparameter": ("", "1", "weight of the prior"),
    **_SHARED,
}
SHARES = {"shares": ("readings n", "1", "share of each pair sum in each reading; absent: 1, -1, -1, 1")}
NUMBERS = LINEAR_NUMBERS | ITERATIVE_NUMBERS | SHARES
"""Shape, unit and meaning of each array of a stored reconstructor, by its name.

Readings of a protocol of matrices, and those of amplifiers with a `CommonMode`, have ``shares``.
"""

_KINDS = {"pairs": "iu", "edges": "iu", "channels": "b"}
_WORDS = {"f": "floating point", "iu": "integers", "b": "boolean"}


class StorageError(ValueError):
    """A file or numbers that are no reconstructor; the message says what is wrong, and where.

    Example:
        try:
            je.load_reconstructor("recon.toml")
        except je.imaging.StorageError as error:
            print(error)
    """


def to_numbers(recon: Reconstructor | IterativeReconstructor) -> dict[str, np.ndarray]:
    """The arrays of a reconstructor under the names of `NUMBERS`; of an iterative one, all but its method and prior.

    Example:
        # for a file format of your own; NUMBERS has shapes, units and meanings
        numbers = je.imaging.to_numbers(recon)
        for name, array in numbers.items():
            print(name, array.shape, je.imaging.NUMBERS[name][1:])
        again = je.imaging.from_numbers(numbers, recon.shape, recon.extent, recon.provenance)
    """
    require_known("to_numbers", StorageError, recon)
    parts = (recon, recon.whitening, recon.picture)
    shares = () if recon.whitening.shares is None else tuple(SHARES)
    if isinstance(recon, Reconstructor):
        return {name: _part(parts, name) for name in (*LINEAR_NUMBERS, *shares)}
    problem = recon.problem
    own = {
        "jacobian": np.asarray(problem.jacobian),
        "count": np.asarray(problem.readings),
        "hyperparameter": np.asarray(problem.hyperparameter),
    }
    return {name: own[name] if name in own else _part(parts, name) for name in (*ITERATIVE_NUMBERS, *shares)}


def _part(parts: tuple[Any, ...], name: str) -> np.ndarray:
    return np.asarray(next(vars(part)[name] for part in parts if name in vars(part)))


@overload
def from_numbers(
    numbers: Mapping[str, np.ndarray],
    shape: tuple[int, ...],
    extent: tuple[float, ...],
    provenance: Mapping[str, str] | None = None,
) -> Reconstructor: ...


@overload
def from_numbers(
    numbers: Mapping[str, np.ndarray],
    shape: tuple[int, ...],
    extent: tuple[float, ...],
    provenance: Mapping[str, str] | None,
    imaging: Imaging | None,
) -> Reconstructor | IterativeReconstructor: ...


def from_numbers(
    numbers: Mapping[str, np.ndarray],
    shape: tuple[int, ...],
    extent: tuple[float, ...],
    provenance: Mapping[str, str] | None = None,
    imaging: Imaging | None = None,
) -> Reconstructor | IterativeReconstructor:
    """The reconstructor with these arrays; the reverse of `to_numbers`.

    Args:
        imaging: names the method and the prior of an iterative reconstructor; the arrays of a linear one are complete.

    Raises:
        StorageError: if an array is missing, they do not fit each other, or the method is needed and not iterative.
    """
    iterative = "jacobian" in numbers
    names = [*(ITERATIVE_NUMBERS if iterative else LINEAR_NUMBERS), *(SHARES.keys() & numbers.keys())]
    missing = [name for name in names if name not in numbers]
    if missing:
        raise StorageError(f"{missing[0]}: missing")
    sizes = _sizes({name: numbers[name] for name in names})
    if "shares" not in numbers and sizes["n"] != 4:
        raise StorageError(f"pairs: names {sizes['n']} pair sums for each reading; without shares, give four")
    if len(extent) != 4 or not np.isfinite(extent).all() or math.prod(shape) != sizes["basis"]:
        raise StorageError(
            f"a picture of shape {shape} and extent {extent} does not hold {sizes['basis']} coefficients"
        )
    for name, what, count in (("pairs", "pair sums", sizes["k"]), ("edges", "coefficients", sizes["basis"])):
        array = np.asarray(numbers[name])
        if ((array < 0) | (array >= count)).any():
            raise StorageError(f"{name}: must count the {count} {what} from 0")
    _require_possible({name: np.asarray(numbers[name]) for name in names})
    predict = jax.device_put(numbers["predict"])
    whitening, picture = _whitening(numbers, sizes["k"], predict.dtype), _picture(numbers, shape, extent)
    about = Provenance(provenance or {})
    if iterative:
        return _iterative(numbers, imaging, predict, whitening, picture, about)
    factor, variance = jax.device_put(numbers["factor"]), jax.device_put(numbers["variance"])
    return Reconstructor(
        factor=factor, variance=variance, predict=predict, whitening=whitening, picture=picture, provenance=about
    )


def _iterative(
    numbers: Mapping[str, np.ndarray],
    imaging: Imaging | None,
    predict: Float[Array, "k k"],
    whitening: Whitening,
    picture: Picture,
    provenance: Provenance,
) -> IterativeReconstructor:
    if imaging is None or not isinstance(imaging.method, AbstractIterativeMethod):
        raise StorageError(
            "the arrays are of an iterative method; give Imaging(method=..., prior=...) that they are for"
        )
    problem = Problem(
        jacobian=jax.device_put(numbers["jacobian"]),
        readings=jax.device_put(numbers["count"]),
        hyperparameter=jax.device_put(numbers["hyperparameter"]),
        prior=imaging.prior,
        picture=picture,
    )
    return IterativeReconstructor(
        compress=jax.device_put(numbers["compress"]),
        problem=problem,
        method=imaging.method,
        predict=predict,
        whitening=whitening,
        picture=picture,
        provenance=provenance,
    )


def _whitening(numbers: Mapping[str, np.ndarray], k: int, dtype: np.dtype) -> Whitening:
    pairs, shares = np.asarray(numbers["pairs"]), numbers.get("shares")
    lines, sign = lines_of(pairs, k) if shares is None else lines_of_shares(pairs, np.asarray(shares), k)
    return Whitening(
        pairs=jnp.asarray(numbers["pairs"], jnp.int32),
        lines=jnp.asarray(lines, jnp.int32),
        sign=jnp.asarray(sign, dtype),
        current=jax.device_put(numbers["current"]),
        weight=jax.device_put(numbers["weight"]),
        channels=jnp.asarray(numbers["channels"], bool),
        shares=None if shares is None else jax.device_put(shares),
    )


def _picture(numbers: Mapping[str, np.ndarray], shape: tuple[int, ...], extent: tuple[float, ...]) -> Picture:
    return Picture(
        centres=jax.device_put(numbers["centres"]),
        areas=jax.device_put(numbers["areas"]),
        edges=jnp.asarray(numbers["edges"], jnp.int32),
        edge_length=jax.device_put(numbers["edge_length"]),
        shape=tuple(shape),
        extent=(extent[0], extent[1], extent[2], extent[3]),
    )


def _sizes(numbers: Mapping[str, np.ndarray]) -> dict[str, int]:
    """The size of each dimension in `NUMBERS`; they must agree, and the numbers be finite."""
    sizes: dict[str, int] = {}
    for name, given in numbers.items():
        dimensions, array = NUMBERS[name][0], np.asarray(given)
        if array.dtype.kind not in _KINDS.get(name, "f") or array.dtype == np.float16:
            raise StorageError(f"{name}: is of type {array.dtype}; it must be {_WORDS[_KINDS.get(name, 'f')]}")
        words = dimensions.replace("*", "readings" if array.ndim == 2 else "").split()
        if len(words) != array.ndim:
            raise StorageError(f"{name}: has shape {array.shape}; it must be ({', '.join(words)})")
        expected = tuple(
            int(word) if word.isdigit() else sizes.setdefault(word, n)
            for word, n in zip(words, array.shape, strict=True)
        )
        if array.shape != expected:
            raise StorageError(f"{name}: has shape {array.shape}; it must be ({', '.join(words)}), here {expected}")
        if not np.isfinite(array).all() and name != "variance":
            raise StorageError(f"{name}: holds values that are not finite")
    return sizes


_NOT_NEGATIVE = ("areas", "edge_length", "variance")
_POSITIVE = ("current", "count", "hyperparameter")


def _require_possible(numbers: Mapping[str, np.ndarray]) -> None:
    """Refuse numbers that no reconstructor has: of two precisions, areas below zero, a current of zero, noise without a
    covariance."""
    precision = {name: array.dtype.itemsize for name, array in numbers.items() if array.dtype.kind == "f"}
    if unlike := [name for name in precision if precision[name] != precision["predict"]]:
        kinds = numbers[unlike[0]].dtype, numbers["predict"].dtype
        raise StorageError(f"{unlike[0]}: is of type {kinds[0]}, and predict of type {kinds[1]}; they must be of one")
    for name, array in numbers.items():
        if (name in _NOT_NEGATIVE and not (array >= 0).all()) or (name in _POSITIVE and not (array > 0).all()):
            least = "zero or more" if name in _NOT_NEGATIVE else "above zero"
            raise StorageError(f"{name}: holds {array.min():g}; it must be {least}")
    weight = numbers["weight"]
    if not (is_covariance(weight) if weight.ndim == 2 else (weight >= 0).all()):
        raise StorageError("weight: is not the inverse of a variance or of a covariance matrix")


def save_reconstructor(recon: Reconstructor, path: str | Path) -> None:
    """Write numbers and provenance to ``path`` (a NumPy .npz), whole or not at all.

    Raises:
        StorageError: for a reconstructor that is not linear, as the file holds a matrix; where ``path`` is a file of
            another kind, which would be lost.
    """
    if not isinstance(recon, Reconstructor):
        raise StorageError(
            f"{Path(path).name}: {type(recon).__name__} works on each frame anew and has no matrix to save; prepare "
            "with a linear method, such as OneStep, or save the calibration that it belongs to"
        )
    about = {"format": FORMAT, "shape": recon.shape, "extent": recon.extent, "provenance": recon.provenance}
    write_arrays(path, {"about": np.array(json.dumps(about)), **to_numbers(recon)}, StorageError)


def load_reconstructor(path: str | Path) -> Reconstructor:
    """Read what `save_reconstructor` wrote.

    Raises:
        StorageError: if the file cannot be read, is damaged or of another kind.
    """
    name = Path(path).name
    numbers = read_arrays(path, StorageError, "reconstructor", "prepare and save it again with save_reconstructor")
    try:
        about = json.loads(str(numbers.pop("about")))
        if about["format"] != FORMAT:
            raise StorageError(f"is a {about['format']!r}; this version reads {FORMAT!r}")
        return from_numbers(numbers, tuple(about["shape"]), tuple(about["extent"]), about["provenance"])
    except StorageError as error:
        raise StorageError(f"{name}: {error}") from None
    except DAMAGE as error:
        why = " ".join(str(error).split())[:120]
        raise StorageError(f"{name}: is damaged or no reconstructor ({why}); prepare and save it again") from None
