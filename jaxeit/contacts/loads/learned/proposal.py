"""Loads proposed by a network that was trained in simulation: what a frame looks like, in NumPy, without a fit.

A frame ``d`` in units of the noise is compressed to its components ``z = U^T d`` in the directions that frames of the
training have. With s their standard deviations, the best linear guess of the components from the readings R that are
there is ``z = (S^-2 + U_R^T U_R)^-1 U_R^T d_R``. The network sees ``z / |z|``, ``log |z|`` and the forces on the pads.
It was trained where coats, gains, shapes, forces and places are drawn at random, so that it has learned to ignore what
it cannot know; it knows no more than its scenes, and says how far a frame is from these.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from ....array_files import read_arrays, write_arrays
from ....imaging.inputs import InverseError, require_real
from ....messages.kinds import require_unmasked
from ....skin import Skin, skin_hash
from ..pressure import FORMS
from ..result import LoadKind, Proposed

FORMAT = "jaxeit proposal 1"
# Rows and parameters of the loads of each kind, in the order of the network's outputs.
SHAPES = {kind: (len(forms), max(form.parameters for form in forms)) for kind, forms in FORMS.items()}
PARAMETERS = sum(rows * size for rows, size in SHAPES.values())
KINDS = len(LoadKind)
LAYERS = 3
# A frame with fewer readings than three loads have parameters cannot tell the kinds of loads from one another.
MIN_READINGS = max(rows * size for rows, size in SHAPES.values())
# V; a larger number is no voltage and is missing, as in streams of recordings.
MAX_READING = 1e18
# Of the log size above its mean in the training: 30,000 times the usual signal or more.
MAX_DEVIATIONS = 8.0
WEIGHTS = tuple(f"{part}{layer}" for layer in range(LAYERS) for part in ("weight", "bias"))


def loads_by_kind(values: Any) -> dict[LoadKind, Any]:
    """Parameters of the loads of all kinds, (n, 30), apart: (n, rows, size) of each kind; NumPy or JAX."""
    ends = np.cumsum([rows * size for rows, size in SHAPES.values()])
    return {
        kind: values[..., end - rows * size : end].reshape(-1, rows, size)
        for end, (kind, (rows, size)) in zip(ends.tolist(), SHAPES.items(), strict=True)
    }


@dataclass(frozen=True, eq=False)
class Proposal:
    """Frames to proposed loads; made by `jaxeit train`, read by `load_proposal`.

    The names of the fields are those in the file.

    | meaning                                                                     | shape                | unit |
    |-----------------------------------------------------------------------------|----------------------|------|
    | noise of a reading in the training                                          | ()                   | V    |
    | basis: orthonormal directions U of the whitened frame                       | (readings, r)        | 1    |
    | spread: standard deviations s along the directions, in units of the noise   | (r,)                 | 1    |
    | mean, deviation of ``z / |z|`` and ``log |z|``                              | (r + 1,)             | 1    |
    | weight0, weight1, weight2: of the layers, between which stands max(x, 0)    | (outputs, inputs)    | 1    |
    | bias0, bias1, bias2: of the layers                                          | (outputs,)           | 1    |
    | temperature: by which the first outputs are divided for probabilities       | ()                   | 1    |
    | offset, scale: from the other outputs to the parameters of loads            | (30,)                | m, 1 |
    | unexplained: part of the signal that no direction has, in the training      | ()                   | 1    |
    | limits of squared distance and of chi-square over the readings              | (2,)                 | 1    |
    | pads: number of pads, whose forces are inputs                               |                      |      |
    | about: skin and its hash, seed, scenes, versions, figures on held-out scenes |                     |      |

    Example:
        proposal = je.contacts.shipped_proposal(skin)
        said = proposal(np.asarray(dv))  # microseconds: a network that was trained for this skin
        print(said.kind.name, said.probability, "unlike its training:", said.outside)
    """

    noise: np.ndarray
    basis: np.ndarray
    spread: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    weight0: np.ndarray
    bias0: np.ndarray
    weight1: np.ndarray
    bias1: np.ndarray
    weight2: np.ndarray
    bias2: np.ndarray
    temperature: np.ndarray
    offset: np.ndarray
    scale: np.ndarray
    unexplained: np.ndarray
    limits: np.ndarray
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def pads(self) -> int:
        """Number of pads, each of which has two inputs."""
        return (int(self.weight0.shape[1]) - len(self.mean)) // 2

    def __call__(
        self, dv: Float[ArrayLike, "*n readings"], pad_forces: Float[ArrayLike, "*n pads"] | None = None
    ) -> Proposed:
        """Loads in a difference of frames, V, with the forces on the pads, N, where they are known.

        Readings and forces that are not finite are missing: electrodes or pads that are dead. A frame with missing
        readings takes about a millisecond, another one a twentieth of that. A frame with hardly any reading is
        ``outside``, with even probabilities.

        Raises:
            InverseError: if the frame has another number of readings, or the pads another number of forces.
        """
        require_real(dv=dv)
        require_unmasked({"pad_forces": pad_forces}, InverseError)
        dv = np.asarray(dv, float)
        if dv.ndim == 0 or dv.shape[-1] != len(self.basis):
            raise InverseError(f"dv has shape {dv.shape}; the proposal is for frames of {len(self.basis)} readings")
        batch = dv.shape[:-1]
        forces = np.full((*batch, self.pads), np.nan) if pad_forces is None else np.asarray(pad_forces, float)
        if forces.shape != (*batch, self.pads):
            raise InverseError(f"pad_forces has shape {forces.shape}; give one force to each of {self.pads} pads")
        frames = dv.reshape(-1, len(self.basis))
        found = self._frames(frames, forces.reshape(len(frames), self.pads))
        return Proposed(*(part.reshape((*batch, *part.shape[1:])) for part in found))

    def _frames(self, dv: Float[np.ndarray, "n readings"], forces: Float[np.ndarray, "n pads"]) -> Proposed:
        """Loads in some frames."""
        known = np.where(np.abs(dv) <= MAX_READING, dv, np.nan)
        few = np.isfinite(known).sum(1) < MIN_READINGS
        known[few] = 0.0
        z, left, count = components(known / self.noise, self.basis, self.spread)
        seen, size = standardised(z, self.mean, self.deviation)
        unknown = few | (seen[:, -1] > MAX_DEVIATIONS)
        hidden = np.concatenate([seen, pad_inputs(forces)], -1).astype(np.float32)
        for layer in range(LAYERS):
            hidden = hidden @ getattr(self, f"weight{layer}").T + getattr(self, f"bias{layer}")
            hidden = np.maximum(hidden, 0) if layer < LAYERS - 1 else hidden
        distance = np.max(self.surprise(seen, size, left, count) / self.limits, 1)
        found = self._proposed(hidden.astype(float), np.where(unknown, np.inf, distance))
        return found._replace(probability=np.where(unknown[:, None], 1 / KINDS, found.probability))

    def surprise(
        self,
        seen: Float[np.ndarray, "n i"],
        size: Float[np.ndarray, " n"],
        left: Float[np.ndarray, " n"],
        count: Int[np.ndarray, " n"],
    ) -> Float[np.ndarray, "n 2"]:
        """How unlike those of the training frames are, from what `components` and `standardised` return.

        The squared distance of their directions, in units of their deviations and of what noise does to them; and
        chi-square over the readings of what no component explains.
        """
        over_noise = (size[:, None] * self.deviation[:-1]) ** 2
        far = np.sum(seen[:, :-1] ** 2 * over_noise / (1 + over_noise), 1)
        return np.stack([far, left / (count + (self.unexplained * size) ** 2)], 1)

    def _proposed(self, outputs: np.ndarray, distance: np.ndarray) -> Proposed:
        """Probabilities and loads from what the last layer says."""
        logs = outputs[..., :KINDS] / self.temperature
        odds = np.exp(logs - logs.max(-1, keepdims=True))
        values = self.offset + self.scale * outputs[..., KINDS:]
        loads = {kind.name.lower(): part for kind, part in loads_by_kind(values).items()}
        return Proposed(odds / odds.sum(-1, keepdims=True), distance=distance, **loads)

    def require_skin(self, skin: Skin) -> None:
        """Raise an error if the proposal was trained for another skin.

        Raises:
            InverseError: if the skin differs from that of the training in more than names (`jaxeit.skin.skin_hash`).
        """
        if self.about.get("skin_sha256") != skin_hash(skin):
            raise InverseError(
                f"the proposal was trained for another skin ({self.about.get('skin', 'unnamed')}) than {skin.name}; "
                "train one for this skin with jaxeit train"
            )

    def save(self, path: str | Path) -> None:
        """Write the proposal as a NumPy .npz, whole or not at all; equal proposals give equal bytes.

        Raises:
            InverseError: where ``path`` is a file of another kind, which would be lost.
        """
        numbers = {name: getattr(self, name) for name in NUMBERS}
        about = {"format": FORMAT} | dict(self.about)
        write_arrays(path, {"about": np.array(json.dumps(about, indent=1))} | numbers, InverseError)


NUMBERS = tuple(each.name for each in fields(Proposal) if each.name != "about")


PROPOSALS = Path(__file__).parents[1] / "proposals"


def shipped_proposal(skin: Skin) -> Proposal | None:
    """The shipped proposal that was trained for a skin, whatever its name; None: there is none."""
    every, wanted = (load_proposal(path) for path in sorted(PROPOSALS.glob("*.npz"))), skin_hash(skin)
    return next((found for found in every if found.about.get("skin_sha256") == wanted), None)


def load_proposal(path: str | Path) -> Proposal:
    """Read what `jaxeit train` wrote, or a shipped proposal by the name of its skin: ``"testbed"``, ``"chest"``.

    Raises:
        InverseError: if the file cannot be read, is damaged or of another kind.
    """
    shipped = PROPOSALS / f"{path}.npz"
    path = shipped if shipped.is_file() and not Path(path).exists() else Path(path)
    name = path.name
    arrays = read_arrays(path, InverseError, "proposal", "train it again with jaxeit train")
    try:
        about = json.loads(str(arrays.pop("about")))
        if about.pop("format") != FORMAT:
            raise InverseError(f"{name}: is no proposal that this version reads; train it again with jaxeit train")
        wide = {key: value.astype(np.float32 if key in WEIGHTS else float) for key, value in arrays.items()}
        found = Proposal(**wide, about=about)
    except InverseError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InverseError(f"{name}: is no proposal ({' '.join(str(error).split())[:80]}); train it again") from None
    if why := _contradiction(found):
        raise InverseError(f"{name}: {why}; train it again with jaxeit train")
    return found


def _contradiction(found: Proposal) -> str:
    """What of the arrays cannot be; empty: nothing."""
    wide, inputs, pads = len(found.mean), np.shape(found.weight0)[-1:], found.pads
    middle = [len(found.bias0), len(found.bias1)]
    expected = {
        "basis": (len(found.basis), wide - 1), "spread": (wide - 1,), "deviation": (wide,),
        "weight0": (middle[0], wide + 2 * pads), "weight1": (middle[1], middle[0]),
        "weight2": (KINDS + PARAMETERS, middle[1]), "bias2": (KINDS + PARAMETERS,), "offset": (PARAMETERS,),
        "scale": (PARAMETERS,), "limits": (2,), "noise": (), "temperature": (), "unexplained": (),
    }  # fmt: skip
    wrong = [name for name, shape in expected.items() if np.shape(getattr(found, name)) != shape]
    infinite = [name for name in NUMBERS if not np.isfinite(getattr(found, name)).all()]
    if wrong or inputs != (wide + 2 * pads,):
        return f"the shapes of {', '.join(wrong) or 'the layers'} do not fit the others"
    if infinite or min(found.noise, found.temperature, *found.deviation, *found.spread, *found.limits) <= 0:
        return f"{', '.join(infinite) or 'noise, temperature, deviation, spread or limits'} cannot be"
    return ""


def components(
    d: Float[np.ndarray, "n readings"], basis: Float[np.ndarray, "readings r"], spread: Float[np.ndarray, " r"]
) -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Components of frames, the squares of what they leave, and the number of readings that are there."""
    there = np.isfinite(d)
    z = np.where(there, d, 0) @ basis
    if not there.all():
        patterns, which = np.unique(there, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            rows, lacking = basis[pattern], which == number
            if not pattern.all():
                z[lacking] = np.linalg.solve(np.diag(spread**-2) + rows.T @ rows, z[lacking].T).T
    left = np.sum(np.where(there, d - z @ basis.T, 0) ** 2, -1)
    return z, left, there.sum(-1)


def standardised(
    z: Float[np.ndarray, "n r"], mean: Float[np.ndarray, " i"], deviation: Float[np.ndarray, " i"]
) -> tuple[Float[np.ndarray, "n i"], Float[np.ndarray, " n"]]:
    """Direction and log size of components in units of their deviations, and the size."""
    size = np.maximum(np.linalg.norm(z, axis=-1), np.finfo(float).tiny)
    return (np.concatenate([z / size[..., None], np.log(size)[..., None]], -1) - mean) / deviation, size


def pad_inputs(forces: Float[np.ndarray, "n pads"]) -> Float[np.ndarray, "n inputs"]:
    """Forces on the pads as the network sees them, and which of them are known."""
    known = np.isfinite(forces)
    return np.concatenate([np.where(known, np.log1p(np.maximum(np.where(known, forces, 0), 0)), 0), known], -1)
