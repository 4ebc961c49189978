"""What ``jaxeit train`` does: scenes, network, tests on further skins, and the file."""

import itertools
import shutil
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.contacts.loads.learned import SHAPES, WEIGHTS, Proposal, pad_inputs
from jaxeit.skin import skin_hash

from ..batch.digests import digest
from ..batch.random_frames import write_training_frames
from ..bench import BenchError, FrameSet, TrainingFrames, open_training_frames
from ..bench.training.scene_frames import SHARD_FRAMES
from .inputs import Compression, Inputs, calibrated_forces, fit_compression, inputs_of, without_an_electrode
from .quality import figures_of, fit_temperature
from .scenes import noise_of, scenes_for, training_bench
from .targets import Targets, targets_of
from .training import TOLERANCES, Examples, train

FRAMES = 300 * SHARD_FRAMES
MIN_SHARDS = 8
EPOCHS = 30
TRAINED, TUNED = 0.8, 0.9  # shares of the skins: up to the first for weights, up to the second for what is tuned
FAR = 99.8  # percentile of scenes beyond which a frame counts as unlike them
PIXELS = je.Pixels(4)  # force maps are not used
TINY = 1e-30  # least probability whose logarithm counts
PLACE_UNIT = 0.25  # of the root of the sheet's area


# Called with the name of a stage, what is done of it, and of how much.
Progress = Callable[[str, int, int], object]


def train_proposal(
    skin: je.Skin,
    path: str | Path,
    *,
    frames: int = FRAMES,
    epochs: int = EPOCHS,
    seed: int = 0,
    fidelity: je.Fidelity | None = None,
    executor: Executor | None = None,
    jobs: int = 1,
    progress: Progress = lambda stage, done, of: None,
) -> Proposal:
    """Train a proposal of contacts for a skin on scenes drawn at random, and write it.

    An interruption leaves whole shards of scenes and a checkpoint in the folder ``PATH.parts``, from which the same
    call goes on; the folder is removed at the end. Equal arguments give equal bytes on the same machine with the same
    versions, whatever the number of processes. Call it below ``if __name__ == "__main__":``.

    Args:
        path: of the file, .npz.
        frames: number of scenes, at least 8,192; a tenth of the skins tests the result, a tenth tunes it.
        epochs: passes over the scenes.
        seed: of scenes and weights.
        fidelity: of the simulation; default `jaxeit.Fidelity.draft(dtype="float32")`.
        executor, jobs: as for `calib.write_training_frames`.
        progress: called with the name of a stage, what is done of it, and of how much.

    Raises:
        BenchError: nothing can be simulated so, or the folder holds something else.
        ProtocolError: for a protocol of matrices (`Protocol.from_matrices`).
    """
    if frames < MIN_SHARDS * SHARD_FRAMES:
        raise BenchError(f"{frames} frames are too few to hold skins out; give {MIN_SHARDS * SHARD_FRAMES:,} or more")
    skin.protocol.rows("a proposal")
    fidelity, parts = fidelity or je.Fidelity.draft(dtype="float32"), Path(f"{path}.parts")
    workers = {"executor": executor, "jobs": jobs}
    every = _simulated(skin, parts / "frames", frames, seed, fidelity, partial(progress, "skins"), **workers)
    choices = digest(every.card["mark"], str((frames, epochs, seed)))[:16]
    checkpoint = parts / f"checkpoint-{choices}.eqx"
    proposal = _trained(skin, every, epochs, seed, checkpoint, lambda done: progress("epochs", done, epochs))
    proposal.save(path)
    shutil.rmtree(parts)
    return proposal


def _simulated(
    skin: je.Skin,
    folder: Path,
    frames: int,
    seed: int,
    fidelity: je.Fidelity,
    tell: Callable[[int, int], object],
    **workers: Any,
) -> TrainingFrames:
    """Scenes drawn at random; those that lie in the folder are not simulated again.

    Args:
        tell: called with the number of skins that are done, and of all.
        workers: as for `calib.write_training_frames`.
    """
    skins, made = -(-frames // SHARD_FRAMES), itertools.count(1)
    bench = replace(training_bench(skin), seed=seed)
    frame_set = FrameSet(bench, frames, fidelity, PIXELS, scenes_for(skin, fidelity))
    write_training_frames(frame_set, folder, tell=lambda _: tell(next(made), skins), **workers)
    return open_training_frames(folder)


def _trained(
    skin: je.Skin, every: TrainingFrames, epochs: int, seed: int, checkpoint: Path, tell: Callable[[int], object]
) -> Proposal:
    """The proposal after training, tuning and tests, each on other skins."""
    rng = np.random.default_rng([seed, 1])
    parts = [every.part(a, b) for a, b in ((0, TRAINED), (TRAINED, TUNED), (TUNED, 1))]
    noise = noise_of(training_bench(skin))
    compression = fit_compression(parts[0], noise)
    low, high = (np.asarray(corner, float) for corner in skin.domain.bounds)
    offset, scale, tolerance = _output_units(low, high)
    targets = targets_of(parts[0])
    whole = inputs_of(parts[0], compression)
    examples = _examples(parts[0], whole, compression, targets, skin, (offset, scale), rng)
    network = train(examples, tolerance, epochs, seed, checkpoint, tell)
    weights = dict(zip(WEIGHTS, _weights(network), strict=True))
    unexplained = np.sqrt(np.mean(np.maximum(whole.left - whole.readings, 0)) / np.mean(whole.size**2))
    untuned = Proposal(
        **{**compression._asdict(), **weights},
        temperature=np.array(1.0),
        offset=offset,
        scale=scale,
        unexplained=np.array(unexplained),
        limits=np.ones(2),
    )
    proposal = replace(_tuned(untuned, parts[1]), about=_about(skin, every, epochs, seed))
    return replace(proposal, about=dict(proposal.about) | _tested(proposal, parts[2], skin, rng))


def _tested(
    proposal: Proposal, frames: TrainingFrames, skin: je.Skin, rng: np.random.Generator
) -> dict[str, dict[str, Any]]:
    """Figures on skins that gave nothing to the proposal: as they are; without pads; also without an electrode."""
    dv, forces, targets = frames["frames"], calibrated_forces(frames), targets_of(frames)
    lacking = without_an_electrode(dv, skin.protocol.pattern, rng)
    cases = {"held_out": (dv, forces), "without_pads": (dv, None), "without_pads_and_an_electrode": (lacking, None)}
    skins = {"skins": len(frames.shards)}
    return {name: skins | figures_of(proposal(*given), targets) for name, given in cases.items()}


def _output_units(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offset and scale of all outputs for loads, and errors that count as one in units of these."""
    usual = je.contacts.LoadSettings()
    unit = PLACE_UNIT * float(np.sqrt(np.prod(high - low)))
    middle = np.array([*(low + high) / 2, np.log(usual.width), np.log(usual.force), 0, 0])
    size = np.array([unit, unit, usual.width_spread, usual.force_spread, usual.length, usual.length])
    columns = np.concatenate([np.tile(np.arange(wide), rows) for rows, wide in SHAPES.values()])
    return middle[columns], size[columns], (np.array(TOLERANCES) / size)[columns].astype(np.float32)


def _examples(
    frames: TrainingFrames,
    whole: Inputs,
    compression: Compression,
    targets: Targets,
    skin: je.Skin,
    units: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> Examples:
    pattern = skin.protocol.pattern
    damaged = inputs_of(frames, compression, lambda dv: without_an_electrode(dv, pattern, rng))
    pads = pad_inputs(calibrated_forces(frames))
    loads = np.where(np.repeat(targets.known, SIZES, 1), (targets.loads - units[0]) / units[1], 0)
    put = partial(jnp.asarray, dtype=jnp.float32)
    return Examples(
        whole=put(whole.seen),
        damaged=put(damaged.seen),
        pads=put(pads[:, : pads.shape[1] // 2]),
        kind=jnp.asarray(targets.kind, jnp.int32),
        loads=put(loads),
        known=put(targets.known),
    )


SIZES = [rows * size for rows, size in SHAPES.values()]


def _weights(network: eqx.nn.MLP) -> list[np.ndarray]:
    """Weights and biases of all layers, in half precision: the file is small, and errors are below those of the fit."""
    pairs = [(np.asarray(layer.weight, np.float16), np.asarray(layer.bias, np.float16)) for layer in network.layers]
    return [part for pair in pairs for part in pair]


def _tuned(untuned: Proposal, frames: TrainingFrames) -> Proposal:
    """Temperature and limits from skins that gave no weights."""
    proposed = untuned(frames["frames"], calibrated_forces(frames))
    temperature = fit_temperature(np.log(np.maximum(proposed.probability, TINY)), targets_of(frames).kind)
    inputs = inputs_of(frames, Compression(*(getattr(untuned, name) for name in Compression._fields)))
    limits = np.percentile(untuned.surprise(*inputs), FAR, axis=0)
    return replace(untuned, temperature=np.array(temperature), limits=limits)


def _about(skin: je.Skin, every: TrainingFrames, epochs: int, seed: int) -> dict[str, Any]:
    """Where a proposal comes from."""
    card = {name: value for name, value in every.card.items() if name not in ("arrays", "skin_toml")}
    names = ("jaxeit", "jax", "equinox", "optax", "numpy")
    return {
        "skin": skin.name,
        "skin_sha256": skin_hash(skin),
        "seed": seed,
        "epochs": epochs,
        "scenes": card,
        "versions": {name: metadata.version(name) for name in names},
    }
