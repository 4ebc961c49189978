"""Simulate a bench and write its session file. A run that was killed resumes after its last finished block."""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO
from uuid import NAMESPACE_OID, uuid5

import jax
import numpy as np

import jaxeit as je
from jaxeit.messages.kinds import require_kind

from ..session import PressTable, SessionFacts, SessionWriter, Status, StreamFacts
from ..session.argument_checks import call_on
from ..session.outputs import disk_full_named
from .bench import Bench, BenchError
from .motion import BenchMotion
from .streams import AbstractSimulatedStream, SampleBlock, SimulatedStreams, simulated_streams

Progress = Callable[[Iterable[Any]], Iterable[Any]]

SIMULATION = je.Fidelity(edge_length=0.02)
"""Finer than that of a calibration, which must not compensate for the error of its own mesh."""


def simulate(
    bench: Bench,
    path: str | Path,
    *,
    fidelity: je.Fidelity | None = None,
    progress: Progress = iter,
) -> Path:
    """Simulate a bench and write its session file, in memory that does not grow with the duration.

    Finished blocks of samples are kept in a folder beside ``path``, NAME.part. A run that was killed resumes from
    there when it is started again, and gives the same file.

    Args:
        path: of the session file; it appears only when complete.
        fidelity: of the simulation; default: finer than that of the calibration.
        progress: wraps the iteration over blocks, such as `tqdm.tqdm`.

    Raises:
        ValueError: if the skin has no pads, the scene cannot be discretised, or the file cannot be written or is larger
            than the space that is free.
    """
    require_kind(bench, Bench, BenchError, "a Bench", call_on("calib.load_bench", bench), "simulate")
    if not bench.scene.skin.pads:
        other = "je.forward, and frames of --random-scenes, need none"
        raise BenchError(f"the skin {bench.scene.skin.name!r} has no pads for a session to hold; add [[pads]]; {other}")
    fidelity = SIMULATION if fidelity is None else fidelity
    path = Path(path)
    made = simulated_streams(bench, fidelity)
    part = path.with_name(path.name + ".part")
    _require_space(made, part)
    with disk_full_named(path):
        store = _BlockStore(part, _fingerprint(bench, fidelity))
        for name, number, recording in progress(_BlockSequence(made)):
            store.make(name, number, recording)
        _write(made, store, path)
    store.remove()
    return path


def _require_space(made: SimulatedStreams, part: Path) -> None:
    """Refuse a session whose blocks the disk cannot hold, before the first one is simulated.

    Args:
        part: the folder of the blocks; those that an earlier run left there take no further space.
    """
    sizes = {name: 4.0 * recording.samples * len(recording.resting) for name, recording in made}  # single precision
    folder = next(folder for folder in part.absolute().parents if folder.is_dir())
    free = shutil.disk_usage(folder).free + sum(block.stat().st_size for block in part.glob("*.npz"))
    if sum(sizes.values()) > free:
        largest = max(sizes, key=sizes.__getitem__)
        raise BenchError(
            f"the session takes {sum(sizes.values()) / 1e9:,.3g} GB, and {free / 1e9:,.3g} GB are free; most of it is "
            f"{largest}: lower its rate, or press fewer places"
        )


class _BlockSequence:
    """Blocks to simulate, in order. The sequence has a length, so that progress can be displayed."""

    def __init__(self, made: SimulatedStreams):
        self._made = made

    def __len__(self) -> int:
        return sum(recording.blocks for _, recording in self._made)

    def __iter__(self) -> Iterator[tuple[str, int, AbstractSimulatedStream]]:
        for name, recording in self._made:
            for number in range(recording.blocks):
                yield name, number, recording


def _fingerprint(bench: Bench, fidelity: je.Fidelity) -> str:
    """Hash of everything that a block depends on."""
    return hashlib.sha256(f"{_identity(bench)}{fidelity}{metadata.version('jaxeit')}".encode()).hexdigest()


def _identity(bench: Bench) -> str:
    """Hash of a bench, whether a file or Python made it."""
    plan = [getattr(bench, name) for name in bench.__dataclass_fields__ if name != "scene"]
    said = repr((plan, bench.scene.skin.toml, jax.tree.leaves(bench.scene.effects), bench.scene.effects))
    arrays = b"".join(np.ascontiguousarray(a).tobytes() for a in (bench.sites, bench.forces))
    return hashlib.sha256(said.encode() + arrays).hexdigest()


class _BlockStore:
    """Blocks in a folder, one file each, with the state after the block."""

    def __init__(self, folder: Path, fingerprint: str):
        self._folder, self._mark = folder, folder / "fingerprint"
        if not (self._mark.is_file() and self._mark.read_text() == fingerprint):
            if folder.exists() and not self._mark.is_file():
                raise BenchError(f"{folder}: exists and was not made by this program; move it to another place")
            self.remove()
            folder.mkdir(parents=True)
            _replace(self._mark, lambda file: file.write(fingerprint.encode()))
        self._states: dict[str, tuple[int, Any]] = {}

    def make(self, name: str, number: int, recording: AbstractSimulatedStream) -> None:
        """Simulate a block, unless its file exists."""
        if self._file(name, number).exists():
            return
        samples, state = recording.block(number, self._state(name, number, recording))
        if not np.isfinite(samples.values).all():
            raise BenchError(
                f"block {number} of {name} has samples that are no finite numbers; an effect of the scene "
                "makes them: leave effects out, one by one, to find it"
            )
        leaves = {f"state{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        arrays = samples._asdict() | {"values": samples.values.astype(np.float32)} | leaves
        _replace(self._file(name, number), lambda file: np.savez(file, **arrays))
        self._states[name] = number, state

    def read(self, name: str, number: int) -> SampleBlock:
        with np.load(self._file(name, number), allow_pickle=False) as kept:
            return SampleBlock(*(kept[field] for field in SampleBlock._fields))

    def remove(self) -> None:
        if self._folder.exists():
            shutil.rmtree(self._folder)

    def _state(self, name: str, number: int, recording: AbstractSimulatedStream) -> Any:
        if number == 0:
            return recording.start()
        last, state = self._states.get(name, (-1, None))
        if last != number - 1:
            with np.load(self._file(name, number - 1), allow_pickle=False) as kept:
                like = recording.start()
                leaves = [kept[f"state{i}"] for i in range(len(jax.tree.leaves(like)))]
                state = jax.tree.unflatten(jax.tree.structure(like), leaves)
        return state

    def _file(self, name: str, number: int) -> Path:
        return self._folder / f"{name}-{number:06d}.npz"


def _replace(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file that appears whole or not at all."""
    temporary = path.with_name(path.name + ".new")
    with temporary.open("wb") as file:
        write(file)
    os.replace(temporary, path)


# --- the file ------------------------------------------------------------------------------------


def simulated_facts(bench: Bench, title: str, session_id: str | None = None) -> SessionFacts:
    """Facts of a session that is simulated by the scene of a bench; its id is a new one unless given."""
    skin, protocol = bench.scene.skin, bench.scene.skin.protocol
    return SessionFacts(
        title=title,
        skin_name=skin.name,
        skin_toml=skin.toml,
        pattern=protocol.pattern,
        mixing=protocol.mixing,
        current=protocol.current,
        frequency=protocol.frequency,
        offset=protocol.reading_offsets,
        epoch=bench.epoch,
        simulated=True,
        scene=bench.toml,
        seed=bench.seed,
        session_id=session_id,
        license="Apache-2.0",
    )


def _write(made: SimulatedStreams, store: _BlockStore, path: Path) -> None:
    bench = made.bench
    session_id = str(uuid5(NAMESPACE_OID, _identity(bench)))
    writer = SessionWriter(path, simulated_facts(bench, bench.title, session_id))
    about = {
        "eit": ("voltage", "V", bench.eit_step or 2 * float(np.abs(made.eit.resting).max()) / np.iinfo("i2").max),
        "pressure": ("pressure", "Pa", bench.pressure_step),
        "force": ("force", "N", bench.force_step),
    }
    with writer:
        for name, recording in made:
            variable, units, step = about[name]
            writer.add_stream(
                name,
                StreamFacts(
                    variable,
                    units=units,
                    channels=len(recording.resting),
                    rate_hz=recording.rate,
                    dtype="i2",
                    scale_factor=step,
                    transport="simulated",
                ),
            )
            _append(writer, name, recording, store)
        writer.set_presses(_presses(bench))
        writer.set_truth(_truth(made.motion))


def _append(writer: SessionWriter, name: str, recording: AbstractSimulatedStream, store: _BlockStore) -> None:
    """Append all blocks of a stream. Time stamps are the host's times of arrival, moved so that they increase."""
    last, gap = np.iinfo(np.int64).min, False
    for number in range(recording.blocks):
        samples = store.read(name, number)
        if not len(samples.host):
            gap = True
            continue
        index = np.arange(len(samples.host))
        host = np.maximum.accumulate(np.maximum(_nanoseconds(samples.host) - index, last + 1)) + index
        flags = samples.gap.copy()
        flags[0] |= gap
        extras: dict[str, Any] = {}
        if recording.has_clock:
            extras = {"time_device": np.rint(samples.device * 1e6).astype(np.uint64), "time_host": host}
        status = np.where(flags, int(Status.gap_before), 0)
        writer.append(name, host, samples.values, status, **extras)
        last, gap = int(host[-1]), False


def _presses(bench: Bench) -> PressTable:
    timing, count = bench.timing, len(bench.sites)
    start = bench.blank + np.arange(count) * bench.period + timing.rest
    after = np.cumsum([0, timing.ramp, timing.hold, timing.release])
    press, hold0, hold1, release = (_nanoseconds(start + t) for t in after)
    return PressTable(
        x=bench.sites[:, 0],
        y=bench.sites[:, 1],
        tip_diameter=np.full(count, bench.tip_diameter),
        target_force=bench.press_forces + sum(c.force for c in bench.companions),
        t_press=press,
        t_hold0=hold0,
        t_hold1=hold1,
        t_release=release,
        pad=_pad_under(bench),
        accepted=np.ones(count, bool),
        reason=("",) * count,
    )


def _truth(motion: BenchMotion) -> dict[str, tuple[np.ndarray, str]]:
    bench, contacts = motion.bench, motion.forces.shape[1]
    truth = {"contact_position": (motion.places[:, 0], "m")}
    if contacts > 1:
        delay = np.array([0.0, *(c.delay for c in bench.companions)])
        truth |= {
            "contact_positions": (motion.places, "m"),
            "contact_forces": (motion.forces, "N"),
            "contact_delays": (delay, "s"),
        }
    if any(bench.slide):
        truth["slide"] = (np.array(bench.slide), "m")
    return truth


def _pad_under(bench: Bench) -> np.ndarray:
    inside = bench.scene.skin.pads_at(bench.sites)
    return np.where(inside.any(0), inside.argmax(0), -1) if len(inside) else np.full(len(bench.sites), -1)


def _nanoseconds(seconds: np.ndarray) -> np.ndarray:
    return np.rint(seconds * 1e9).astype(np.int64)
