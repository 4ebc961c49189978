"""Damaged and hostile input for everything that reads, in a process with little memory and little time.

    python -m tests.fuzzing COUNT SEED FOLDER KIND...

prints what became of COUNT inputs of each kind, as JSON: how many were refused, read as before, or read as something
else; the longest time of one (s), the growth of memory (bytes), and the first inputs that broke a reader, by their
numbers.
"""

import contextlib
import io
import json
import math
import pickle
import resource
import sys
import tempfile
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np

import calib
import jaxeit as je
from calib.bench import load_bench
from calib.calibration.calibration import Calibration
from calib.calibration.evaluation import Evaluation
from calib.cli import main as command
from calib.fitting.curves import FittedCurve, PowerLaw
from calib.record.journal.conversion import convert_journal
from calib.record.journal.file import Journal, JournalError, JournalReader
from calib.record.journal.records import END, EVENT, PLAN, PONG, EventCode, pack_event, pack_pong
from calib.record.wire.decoding import DecoderState, decode, decode_lines
from calib.record.wire.encoding import encode_frame
from calib.record.wire.framing import cobs_encode, crc16
from calib.record.wire.messages import Layout, Pong
from calib.session import SessionError, open_session
from calib.session.importers import FileSpec, StreamSpec, import_csv
from calib.tanks import TankError, load_tank
from tests.record.test_recorder import both, journal
from tests.session.test_session import everything, make
from tests.tanks import instrument_files

MEMORY = 1 << 30  # bytes beyond what the libraries take
NUMBERS = ("-1", "0", "1e308", "1e-320", "nan", "inf", "-inf", "9" * 400, "1_0", "true", "1979-05-27", "0x7fffffffffff")
WORDS = (*NUMBERS, '""', '"' + "x" * 5000 + '"', "[]", "[[]]", "{}", "[" * 3000 + "]" * 3000, '"\\u0000"', "[1, 'a']")


@dataclass(frozen=True)
class Reader:
    """How a kind of input is made, spoilt and read; errors that are in order; whether it protects itself."""

    original: Callable[[Path], bytes]
    spoil: Callable[[bytes, np.random.Generator], bytes]
    read: Callable[[Path, bytes], Any]
    errors: tuple[type[Exception], ...]
    sealed: bool = True


# --- damage -----------------------------------------------------------------------------------------------------------


def damaged(raw: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, bits flipped, overwritten by noise, zeros or another stretch, a stretch left out or doubled."""
    data, at = bytearray(raw), int(rng.integers(len(raw)))
    size = min(int(rng.integers(1, 400)), len(raw) - at)
    kind = rng.integers(7)
    if kind == 0:
        return bytes(data[:at])
    if kind == 1:
        for place in rng.integers(len(raw), size=rng.integers(1, 4)):
            data[place] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        data[at : at + size] = rng.bytes(size)
    elif kind == 3:
        data[at : at + size] = bytes(size)
    elif kind == 4:
        other = int(rng.integers(len(raw) - size + 1))
        data[at : at + size] = raw[other : other + size]
    elif kind == 5:
        del data[at : at + size]
    else:
        data[at:at] = raw[at : at + size]
    return bytes(data)


def edited(raw: bytes, rng: np.random.Generator) -> bytes:
    """A text with a value, a line or a letter changed."""
    lines = raw.decode().split("\n")
    at = int(rng.integers(len(lines)))
    kind = rng.integers(6)
    if kind < 3:
        assigned = [i for i, line in enumerate(lines) if "=" in line]
        at = assigned[int(rng.integers(len(assigned)))] if assigned else at
        lines[at] = f"{lines[at].split('=')[0]}= {WORDS[int(rng.integers(len(WORDS)))]}"
    elif kind == 3:
        del lines[at]
    elif kind == 4:
        lines.insert(at, lines[int(rng.integers(len(lines)))])
    else:
        return damaged(raw, rng)
    return "\n".join(lines).encode()


def cells(raw: bytes, rng: np.random.Generator) -> bytes:
    """A table of numbers with cells, lines or bytes changed."""
    if rng.integers(3) == 0:
        return damaged(raw, rng)
    rows = [line.split(b",") for line in raw.split(b"\n")]
    for _ in range(int(rng.integers(1, 20))):
        row = rows[int(rng.integers(len(rows)))]
        row[int(rng.integers(len(row)))] = WORDS[int(rng.integers(len(WORDS)))].encode()
    return b"\n".join(b",".join(row) for row in rows)


def replaced(value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another array in the place of one: of another size, rank, type or value."""
    changes = [
        lambda v: v[..., None],
        lambda v: np.concatenate([v.ravel(), v.ravel()]),
        lambda v: np.zeros((0, *v.shape[1:])),
        lambda v: np.full(v.shape, np.nan),
        lambda v: np.full(v.shape, np.inf),
        lambda v: np.full(v.shape, -1),
        lambda v: np.full(v.shape, 2**62),
        lambda v: np.full(v.shape, b"text"),
        lambda v: np.zeros(3, "u1"),
        lambda v: np.asarray(1.0),
        lambda v: v.astype({"f": "f4", "i": "f8", "u": "i8"}.get(v.dtype.kind, v.dtype)),
    ]
    return changes[int(rng.integers(len(changes)))](np.asarray(value))


def rewritten(raw: bytes, rng: np.random.Generator) -> bytes:
    """A sound HDF5 file with arrays or attributes replaced or removed, in our own way of writing."""
    with tempfile.NamedTemporaryFile(suffix=".h5") as copy:
        copy.write(raw)
        copy.flush()
        with h5py.File(copy.name, "r+", libver=("v110", "v110")) as file:
            names: list[str] = []
            file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
            for _ in range(int(rng.integers(1, 3))):
                _change(file, names, rng)
        return Path(copy.name).read_bytes()


def _change(file: h5py.File, names: list[str], rng: np.random.Generator) -> None:
    if rng.integers(2):
        name = names[int(rng.integers(len(names)))]
        if name not in file:
            return
        new = replaced(file[name][()], rng)
        attrs = dict(file[name].attrs)
        del file[name]
        if rng.integers(6):
            options = {"chunks": True, "compression": "gzip", "fletcher32": True} if new.size and new.ndim else {}
            file.create_dataset(name, data=new, **options)
            for key in ("units", "long_name", "kind"):
                if key in attrs:
                    file[name].attrs[key] = attrs[key]
        return
    where = [file, *(file[n] for n in names if n in file)][0 if rng.integers(3) else int(rng.integers(len(names)))]
    keys = [key for key in where.attrs if "LIST" not in key and "CLASS" not in key]
    if not keys:
        return
    key, word = keys[int(rng.integers(len(keys)))], WORDS[int(rng.integers(len(WORDS)))]
    values = [np.bytes_(word), -1, 10**18, np.nan, 0, np.bytes_(b"\xff"), np.zeros(3), None]
    value = values[int(rng.integers(len(values)))]
    del where.attrs[key]
    if value is not None:
        where.attrs[key] = value


def repacked(raw: bytes, rng: np.random.Generator) -> bytes:
    """A sound .npz with members replaced, removed, pickled, claiming terabytes, or packed a thousandfold."""
    with np.load(io.BytesIO(raw)) as file:
        members = {name: _npy(file[name]) for name in file.files}
        arrays = {name: file[name] for name in file.files}
    name = list(members)[int(rng.integers(len(members)))]
    kind, method = rng.integers(8), zipfile.ZIP_STORED
    if kind < 3:
        members[name] = _npy(replaced(arrays[name], rng))
    elif kind == 3:
        del members[name]
    elif kind == 4:
        members[name] = _npy(np.array([Trap()], object))
    elif kind == 5:
        head = {"descr": "<f8", "fortran_order": False, "shape": (300_000_000_000,)}
        members[name] = _header(head) + bytes(64)
    elif kind == 6:
        members[name], method = (
            _header({"descr": "<f8", "fortran_order": False, "shape": (1 << 21,)}) + bytes(1 << 24),
            (zipfile.ZIP_DEFLATED),
        )
    else:
        about = json.loads(str(arrays["about"]))
        about[list(about)[int(rng.integers(len(about)))]] = [-1, 10**30, "x", None, [], [[]], {"a": [1]}, 1e999][
            int(rng.integers(8))
        ]
        members["about"] = _npy(np.array(json.dumps(about)))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as packed:
        for key, data in members.items():
            packed.writestr(f"{key}.npy", data)
    return out.getvalue()


ODD = (-1, 0, 10**30, 1e308, math.nan, "x", "9999-12-31T23:59:59+00:00", "\0", "\ud800", "x" * 70_000, None, True, [])
ODD = (*ODD, [[]], [None], {"a": [1]}, {"simulated": [1], "seed": 10**30}, [[2**40] * 4] * 3, [1e308] * 3)
TEXTS = ("null", "{}", "[true]", "[5, []]", "[99, 0]", "[" * 100_000, "9" * 5000, "\0", "")
ENTRIES = (0, 1, 2, 7, 0x8000, PONG, END, EVENT, PLAN)
TIMES = (-(2**63), -1, 0, 2**62, 2**63 - 1)


def resealed(raw: bytes, rng: np.random.Generator) -> bytes:
    """A sound journal with records changed, left out or repeated, every sum and number right."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "read").write_bytes(raw)
        records = [record[1:] for record in JournalReader(Path(folder, "read"))]
        for _ in range(int(rng.integers(1, 5))):
            _unlike(records, rng)
        with Journal(Path(folder, "written")) as out:
            for record in records:
                out.append(*record)
        return Path(folder, "written").read_bytes()


def _unlike(records: list[tuple[int, int, int, bytes]], rng: np.random.Generator) -> None:
    few = [i for i, record in enumerate(records) if record[0] >= PONG]  # beside many frames
    places = few if few and rng.integers(2) else range(len(records))
    at = places[int(rng.integers(len(places)))]
    stream, flags, host, payload = records[at]
    kind = rng.integers(8)
    if kind == 0:
        stream = ENTRIES[int(rng.integers(len(ENTRIES)))]
    elif kind == 1:
        flags = int(rng.integers(1 << 16))
    elif kind == 2:
        host = [*TIMES, host + 10**12][int(rng.integers(len(TIMES) + 1))]
    elif kind == 3:
        records.insert(int(rng.integers(len(records))), records[at])
    elif payload[:1] in (b"{", b"[") and len(payload) < 10_000:
        payload = _said(json.loads(payload), rng).encode()
    elif kind == 4 and payload:
        payload = damaged(payload, rng)
    elif payload:  # the head of a frame, or an answer to a ping
        data = bytearray(payload)
        data[int(rng.integers(min(16, len(data))))] = int(rng.integers(256))
        payload = bytes(data)
    records[at : at + 1] = [(stream, flags, host, payload)] if rng.integers(9) or len(records) == 1 else []


def _said(table: Any, rng: np.random.Generator) -> str:
    """Another text in the place of one in JSON; mostly the same with one value changed."""
    if rng.integers(6) == 0:
        return TEXTS[int(rng.integers(len(TEXTS)))]
    if not isinstance(table, (dict, list)) or not table:
        return json.dumps(ODD[int(rng.integers(len(ODD)))])
    places = [(table, key) for key in (table if isinstance(table, dict) else range(len(table)))]
    for inner, key in list(places):
        if isinstance(inner[key], list) and inner[key] and isinstance(inner[key][0], dict):
            places += [(stream, name) for stream in inner[key] for name in stream] * 2
    inner, key = places[int(rng.integers(len(places)))]
    odd = ODD[int(rng.integers(len(ODD)))]
    inner[key] = json.dumps(odd) if key == 1 and isinstance(odd, dict) else odd
    return json.dumps(table)


class Trap:
    """An object whose unpickling would be seen."""

    def __reduce__(self):
        return exec, ("import builtins; builtins.sprung = True",)


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _header(about: dict) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, about)
    return out.getvalue()


# --- originals --------------------------------------------------------------------------------------------------------


def session(folder: Path) -> bytes:
    return make(folder / "good.h5").read_bytes()


def small_reconstructor(skin: je.Skin) -> je.Reconstructor:
    """Of four pixels and five readings, without mesh or solver."""
    rng = np.random.default_rng(0)
    numbers = {
        "factor": rng.normal(size=(4, 6)),
        "variance": np.ones(4),
        "predict": np.eye(6),
        "pairs": np.array([[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5], [0, 2, 1, 5], [5, 0, 3, 2]]),
        "current": np.asarray(1e-3),
        "weight": np.ones(5),
        "channels": np.ones(5, bool),
        "centres": np.array([[0.05, 0.05], [0.15, 0.05], [0.05, 0.15], [0.15, 0.15]]),
        "areas": np.full(4, 0.01),
        "edges": np.array([[0, 1], [2, 3], [0, 2], [1, 3]]),
        "edge_length": np.full(4, 0.1),
    }
    return je.imaging.from_numbers(numbers, (2, 2), (0.0, 0.2, 0.0, 0.2), {"skin": skin.name})


def reconstructor(folder: Path) -> bytes:
    je.save_reconstructor(small_reconstructor(je.load_skin("testbed")), folder / "good.npz")
    return (folder / "good.npz").read_bytes()


def calibration(folder: Path) -> bytes:
    skin, rng, presses = je.load_skin("testbed"), np.random.default_rng(0), 6
    recon = small_reconstructor(skin)
    curves = FittedCurve(
        curve=PowerLaw(jnp.full(4, 2000.0)),
        parameters=jnp.tile(jnp.array([4e-3, 1.2]), (4, 1)),
        covariance=jnp.tile(1e-8 * jnp.eye(2), (4, 1, 1)),
        pressure_range=jnp.tile(jnp.array([0.0, 4000.0]), (4, 1)),
        **{name: jnp.ones(4) for name in ("scale", "residual_rms")},
        **{name: jnp.full(4, 9) for name in ("n", "n_missing", "n_groups", "rank")},
        result=jnp.zeros(4, int),
    )
    judged = Evaluation(
        position=rng.uniform(0, 0.2, (presses, 2)),
        estimated={"half_mean": rng.uniform(0, 0.2, (presses, 2))},
        force=np.full(presses, 20.0),
        pressure=rng.uniform(0, 2000, (presses, 4)),
        pad_force=rng.uniform(0, 20, (presses, 4)),
        image_sum=np.ones(presses),
        centre=np.array([0.1, 0.1]),
        held_out_by="location",
    )
    masks = je.fusion.PadMasks(jnp.eye(4), recon.areas)
    about = {"created_utc": "2026-01-01", "curve": "power", "location": "none"}
    Calibration(skin, recon, masks, curves, judged, about, True).save(folder / "good.h5")
    return (folder / "good.h5").read_bytes()


def skin_text(_: Path) -> bytes:
    return je.load_skin("testbed").toml.encode()


def scene_text(_: Path) -> bytes:
    return (Path(calib.__file__).parent / "bench" / "scenes" / "testbed_grid.toml").read_bytes()


def bench_texts(_: Path) -> bytes:
    """The shipped scene with most kinds of effects."""
    return max(
        (Path(calib.__file__).parent / "bench" / "scenes").glob("*.toml"), key=lambda p: p.stat().st_size
    ).read_bytes()


def table(_: Path) -> bytes:
    rng = np.random.default_rng(0)
    rows = [f"{0.01 * i:.2f},{rng.normal():.4f},{rng.normal():.4f}" for i in range(60)]
    return "\n".join(["time,force,pressure", *rows]).encode()


def recording(folder: Path) -> bytes:
    return journal(folder / "good.h5.part", both(20)).read_bytes()


def full_recording(folder: Path) -> bytes:
    """With events, what a simulated device says and answers to pings."""
    seconds = 8 * 10**9
    about = pack_event(EventCode.SIMULATED, json.dumps({"simulated": True, "scene": "a scene", "seed": 3}))
    pongs = [(PONG, 0, seconds + n * 10**8, pack_pong(n % 2, Pong(seconds + n * 10**8 - 10**6, n))) for n in range(4)]
    events = [(EVENT, 0, seconds, pack_event(EventCode.CONNECTED, "tcp://x")), (EVENT, 0, seconds, about)]
    return journal(folder / "full.h5.part", [*events, *both(20), *pongs]).read_bytes()


LAYOUTS = {1: Layout(1, 4, limit=1e3)}


def frames(_: Path) -> bytes:
    values = np.random.default_rng(0).normal(size=(200, 4)).astype("f4")
    return b"".join(encode_frame(1, i, 1000 * i, row) for i, row in enumerate(values))


def lines(_: Path) -> bytes:
    values = np.random.default_rng(0).normal(size=(200, 4))
    return b"".join(b"%d,%d,%.3f,%.3f,%.3f,%.3f\n" % (i, 1000 * i, *row) for i, row in enumerate(values))


def frames_of(write: Callable[[np.ndarray], bytes]) -> Callable[[Path], bytes]:
    """Two frames of an instrument."""
    return lambda _: write(np.random.default_rng(0).uniform(0.01, 1.0, (2, 208)))


# --- reading ----------------------------------------------------------------------------------------------------------


def read_calibration(path: Path, _: bytes):
    """As numbers, and as it would be used."""
    found = calib.load_calibration(path)
    arrays = [np.asarray(getattr(found.curves, f.name)).tobytes() for f in fields(FittedCurve) if f.name != "curve"]
    force, error, valid = found.pad_forces(np.full((3, len(found.skin.pads)), 500.0))
    image = found.recon(np.zeros(found.recon.channels.shape[0]))
    return arrays, force.tobytes(), error.tobytes(), valid.tobytes(), np.asarray(image).tobytes(), found.skin.toml


def read_reconstructor(path: Path, _: bytes):
    found = je.load_reconstructor(path)
    image = np.asarray(found(np.ones(found.channels.shape[0])))
    return image.tobytes(), found.extent, dict(found.provenance)


def read_skin(path: Path, _: bytes):
    return je.load_skin(path).name


def read_bench(path: Path, _: bytes):
    return load_bench(path).duration


def read_table(path: Path, _: bytes):
    streams = (StreamSpec("force", ("1",), "N"), StreamSpec("pressure", ("2",), "kPa"))
    out = path.with_name("out.h5")
    out.unlink(missing_ok=True)
    try:
        import_csv([FileSpec(path, "0", "s", streams, (-1.0,))], out)
        with open_session(out) as found:
            return [stream.read().tobytes() for stream in found.streams.values()]
    finally:
        _nothing_left(path.parent, {path.name, "out.h5"})


def read_journal(path: Path, raw: bytes):
    """A whole session or nothing; every tenth by the command too."""
    out = path.with_name("out.h5")
    out.unlink(missing_ok=True)
    said = io.StringIO()
    try:
        convert_journal(path, out, recovered=True)
    finally:
        _nothing_left(path.parent, {path.name, "out.h5"})
    try:
        everything(out)
    except SessionError as error:
        raise AssertionError(f"written, and not to be read: {error}") from error
    out.unlink()
    if zlib.crc32(raw) % 10:
        return None
    with contextlib.redirect_stdout(said):
        assert command(["recover", str(path), "-o", str(out)]) == 0
    return None


def _nothing_left(folder: Path, known: set[str]) -> None:
    left = {p.name for p in folder.iterdir()} - known
    assert not left, left


def read_frames(_: Path, raw: bytes):
    """Binary frames; and whatever fits its checksum by design, since damage alone seldom does."""
    state, found = decode(LAYOUTS, DecoderState(), raw)
    body = bytes(raw[: 10 + len(raw) % 40])
    state, more = decode(LAYOUTS, state, b"\0" + cobs_encode(body + crc16(body).to_bytes(2, "little")) + b"\0")
    assert all(len(frame.values) == 4 for frame in found + more)
    return [(f.seq, f.ticks, f.values.tobytes()) for f in found]


def read_lines(_: Path, raw: bytes):
    state, found = decode_lines(LAYOUTS, DecoderState(), b"\n" + raw + b"\n")
    assert all(len(frame.values) == 4 for frame in found)
    assert len(state.tail) < 1 << 16
    return len(found)


def read_instrument(path: Path, _: bytes):
    return load_tank(path, je.Disc(0.1)).frames.tobytes()


FILES = (SessionError, je.toml.TomlError)
SUFFIXES = {"reconstructor": ".npz", "journal": ".part", ".get": ".get", ".eit": ".eit"}
"""Of the file, where a reader goes by it and the kind of input has this in its name."""
READERS = {
    "session": Reader(session, damaged, lambda path, _: everything(path), (SessionError,)),
    "hostile session": Reader(session, rewritten, lambda path, _: everything(path), FILES, False),
    "calibration": Reader(calibration, damaged, read_calibration, FILES),
    "hostile calibration": Reader(calibration, rewritten, read_calibration, FILES, False),
    "reconstructor": Reader(reconstructor, damaged, read_reconstructor, (je.imaging.StorageError,)),
    "hostile reconstructor": Reader(reconstructor, repacked, read_reconstructor, (je.imaging.StorageError,), False),
    "skin": Reader(skin_text, edited, read_skin, (je.toml.TomlError,), False),
    "scene": Reader(bench_texts, edited, read_bench, (ValueError,), False),
    "table": Reader(table, cells, read_table, (SessionError,), False),
    "journal": Reader(recording, damaged, read_journal, (JournalError, SessionError), False),
    "hostile journal": Reader(full_recording, resealed, read_journal, (JournalError, SessionError), False),
    "frames": Reader(frames, damaged, read_frames, (), False),
    "lines": Reader(lines, cells, read_lines, (), False),
    ".get": Reader(frames_of(instrument_files.goe_half_get), damaged, read_instrument, (TankError,), False),
    "old .get": Reader(frames_of(instrument_files.draeger_get), damaged, read_instrument, (TankError,), False),
    ".eit": Reader(frames_of(instrument_files.draeger_eit), damaged, read_instrument, (TankError,), False),
    "XML .eit": Reader(frames_of(instrument_files.carefusion_eit), damaged, read_instrument, (TankError,), False),
}


def run(kind: str, count: int, seed: int, folder: Path) -> dict:
    """What became of so many inputs of a kind."""
    reader, rng = READERS[kind], np.random.default_rng(seed)
    work = folder / "work"
    work.mkdir(parents=True)
    raw = reader.original(folder)
    suffix = next((suffix for word, suffix in SUFFIXES.items() if word in kind), ".h5")
    path = work / f"input{suffix}"
    path.write_bytes(raw)
    whole = reader.read(path, raw)  # the sound one compiles what there is to compile
    jax.devices()  # the driver of a GPU takes its address space before the limit, for readers that compile nothing too
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seen, broken, longest = Counter[str](), [], 0.0
    for number in range(count):
        data = reader.spoil(raw, rng)
        path.write_bytes(data)
        start = time.perf_counter()
        try:
            outcome = "as before" if reader.read(path, data) == whole else "different"
        except reader.errors as error:
            outcome = "refused"
            if "\n" in str(error) or len(str(error)) > 7000:
                broken.append([number, f"not one line: {error}"[:300]])
        except BaseException as error:
            outcome = "broken"
            broken.append([number, f"{type(error).__name__}: {error}"[:300]])
        longest = max(longest, time.perf_counter() - start)
        seen[outcome] += 1
    assert "sprung" not in vars(__import__("builtins"))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return {**seen, "longest": longest, "grown": 1024 * grown, "broken_ones": broken[:8]}


if __name__ == "__main__":
    assert pickle.dumps(Trap())
    count, seed, folder, *kinds = sys.argv[1:]
    print(json.dumps({kind: run(kind, int(count), int(seed), Path(folder, kind)) for kind in kinds}))
