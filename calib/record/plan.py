"""Plan of a recording: facts about the session and its streams, and the JSON text with which a journal begins."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import scipy.sparse as sp

from ..session.hdf5.guard import MAX_ATTRIBUTE_BYTES
from ..session.mixing import count_readings, mixing_of_terms
from .journal.file import JournalError
from .wire.messages import Layout

PLAN_FORMAT = "jaxeit-journal"
MAX_TERMS = 25_000  # of the readings of a scan, about 40 bytes each: a record of a journal holds a megabyte


class PlanError(ValueError):
    """A recording cannot be planned in this way.

    Example:
        from calib.record import PlanError

        try:
            plan_recording({}, skin=None)
        except PlanError as error:
            print(error)
    """


@dataclass(frozen=True)
class StreamProperties:
    """Properties of streams of one name: variable, unit, wire number, largest possible magnitude in SI."""

    variable: str
    units: str
    number: int
    limit: float


STREAM_KINDS: Mapping[str, StreamProperties] = {
    "eit": StreamProperties("voltage", "V", 1, 1e3),
    "pressure": StreamProperties("pressure", "Pa", 2, 1e7),
    "force": StreamProperties("force", "N", 3, 1e6),
    "stage": StreamProperties("position", "m", 4, 1e2),
    "temperature": StreamProperties("temperature", "K", 5, 1e4),
    "barometer": StreamProperties("pressure", "Pa", 6, 1e7),
}


def _check_texts(plan: Any) -> None:
    """Raise `PlanError` for a text that cannot be stored as an attribute of a session."""
    for field in fields(plan):
        text = getattr(plan, field.name)
        raw = text.encode(errors="replace") if isinstance(text, str) else b""
        if len(raw) > MAX_ATTRIBUTE_BYTES or b"\0" in raw or (raw and raw.decode() != text):
            limit = f"use at most {MAX_ATTRIBUTE_BYTES:,} bytes of Unicode, none of them zero"
            raise PlanError(f"{field.name}: is a text that cannot be stored; {limit}")


@dataclass(frozen=True)
class StreamPlan:
    """One stream: its contents, and how its device sends it.

    | field         | meaning                                                              |
    |---------------|----------------------------------------------------------------------|
    | name          | a key of `STREAM_KINDS`                                              |
    | channels      | values per frame                                                     |
    | rate          | Hz, 0 if not known                                                   |
    | scale, offset | a value in SI is ``scale * sent + offset``                           |
    | tick          | nominal length of a tick of the device's counter, s                  |
    | number        | number of the stream on the wire; -1 for that of its kind            |
    | transport     | URL of the source, without options                                   |
    """

    name: str
    channels: int
    rate: float = 0.0
    scale: float = 1.0
    offset: float = 0.0
    tick: float = 1e-6
    number: int = -1
    transport: str = ""

    def __post_init__(self) -> None:
        if self.name not in STREAM_KINDS:
            raise PlanError(f"stream {self.name!r} is not known; use one of {', '.join(STREAM_KINDS)}")
        if self.number < 0:
            object.__setattr__(self, "number", self.kind.number)
        for field in ("rate", "scale", "offset", "tick"):
            if not math.isfinite(number := getattr(self, field)):
                raise PlanError(f"{self.name}: {field} {number}; give a finite number")
        if self.rate < 0:
            raise PlanError(f"{self.name}: rate {self.rate} Hz; give the rate in Hz, or 0 if it is not known")
        if not 1e-12 <= self.tick < 1e3:
            raise PlanError(f"{self.name}: tick {self.tick} s; give 1e-12 to 1e3 s")
        self.layout  # noqa: B018  checks channels, scale and number
        _check_texts(self)

    @property
    def kind(self) -> StreamProperties:
        """Variable, unit and limit of its values."""
        return STREAM_KINDS[self.name]

    @property
    def layout(self) -> Layout:
        """Layout that its frames must have."""
        return Layout(self.number, self.channels, self.scale, self.kind.limit)

    def in_si(self, values: np.ndarray) -> np.ndarray:
        """Convert values as sent to f8 in SI; the lowest count means that a value is missing."""
        out = values.astype(np.float64)
        if values.dtype.kind == "i":
            out[values == np.iinfo(values.dtype).min] = np.nan
        return out * self.scale + self.offset


@dataclass(frozen=True)
class RecordingPlan:
    """Plan of a recording: facts for the session file, its time axis, and its streams.

    ``pattern`` (rows, 4), ``mixing`` (reading, row and share of each term; None: each row is one reading), ``current``
    (A), ``frequency`` (Hz) and ``offset`` (readings,) s describe the EIT protocol, or are None. ``epoch`` is an ISO
    time with zone, at which the monotonic clock showed ``host_epoch`` ns. The session file gets ``session_id``,
    ``title``, ``license`` and ``creator`` as they are, name and text of the skin file as ``skin_name`` and
    ``skin_toml``, and of a simulated device (``simulated``) its ``scene`` as TOML and its ``seed``.
    """

    streams: tuple[StreamPlan, ...]
    epoch: str
    host_epoch: int
    session_id: str
    title: str = ""
    skin_name: str = ""
    skin_toml: str = ""
    pattern: tuple[tuple[int, ...], ...] | None = None
    mixing: tuple[tuple[int | float, ...], ...] | None = None
    current: float | None = None
    frequency: float | None = None
    offset: tuple[float, ...] | None = None
    license: str = ""
    simulated: bool = False
    scene: str | None = None
    seed: int | None = None
    creator: str | None = None

    def __post_init__(self) -> None:
        names = [stream.name for stream in self.streams]
        if not names or len({*names}) < len(names):
            raise PlanError(f"streams {', '.join(names) or 'none'}; name each of them once, at least one")
        if datetime.fromisoformat(self.epoch).tzinfo is None:
            raise PlanError(f"epoch {self.epoch}: has no time zone")
        self._check_storable()
        eit = [s.channels for s in self.streams if s.name == "eit"]
        if eit and self._readings() != eit[0]:
            kind = "rows" if self.mixing is None else "readings"
            rows = "no pattern" if self.pattern is None else f"a pattern of {self._readings()} {kind}"
            raise PlanError(f"eit: {eit[0]} readings beside {rows}; give the skin whose protocol is measured")

    def _readings(self) -> int | None:
        """Number of readings of the EIT protocol; None without one."""
        return None if self.pattern is None else count_readings(self.pattern, self.mixing_matrix())

    def mixing_matrix(self) -> sp.csr_array | None:
        """``mixing`` as a matrix (readings, rows); raises `PlanError` for terms that are none."""
        if self.mixing is None:
            return None
        if len(self.mixing) > MAX_TERMS:
            raise PlanError(
                f"a scan of {len(self.mixing):,} terms is too long for a journal, which holds {MAX_TERMS:,}; give the "
                "skin a scan of pairs, or one through fewer electrodes"
            )
        try:
            reading, row, share = np.array(self.mixing, float).reshape(-1, 3).T
            return mixing_of_terms(reading.astype(int), row.astype(int), share, len(self.pattern or ()))
        except ValueError as error:
            raise PlanError(f"mixing: {error}; give reading, row and share of each term") from None

    def _check_storable(self) -> None:
        """Raise `PlanError` for facts that the session file, made only after the recording, could not store."""
        _check_texts(self)
        if any(len(row) != 4 or min(row) < 0 or max(row) >= 1 << 15 for row in self.pattern or ()):
            raise PlanError("pattern: names impossible electrodes; give four of each reading, counted from 0")
        if any(abs(number) >= 2**62 for number in (self.host_epoch, self.seed or 0)):
            raise PlanError(f"host_epoch {self.host_epoch} or seed {self.seed}: too large; keep below 2^62")
        if self.simulated and (self.scene is None or self.seed is None):
            raise PlanError("scene: a simulated recording does not say how; give scene and seed")

    @property
    def moment(self) -> datetime:
        """The epoch as a time in UTC."""
        return datetime.fromisoformat(self.epoch).astimezone(UTC)

    def to_json(self) -> bytes:
        """The plan as JSON, as the first record of a journal holds it."""
        return json.dumps({"format": PLAN_FORMAT, "version": 1, **asdict(self)}).encode()


def plan_from_json(text: bytes) -> RecordingPlan:
    """The plan of a journal from its JSON text; raises `JournalError` for any other text."""
    try:
        table: dict[str, Any] = json.loads(text)
        if table.pop("format") != PLAN_FORMAT or table.pop("version") != 1:
            raise JournalError("journal: of another format or version; use the jaxeit that wrote it")
        table["streams"] = tuple(_typed(StreamPlan, stream) for stream in table["streams"])
        table.setdefault("mixing", None)  # of plans before version 1.1 of the session file
        for name in ("pattern", "mixing", "offset"):
            table[name] = table[name] and tuple(tuple(v) if isinstance(v, list) else v for v in table[name])
        plan: RecordingPlan = _typed(RecordingPlan, {f.name: table[f.name] for f in fields(RecordingPlan)})
        return plan
    except JournalError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        why = " ".join(str(error).split())[:200]
        raise JournalError(f"journal: its description cannot be read ({why})") from error


def _typed(kind: type, table: dict[str, Any]) -> Any:
    """Construct an object after checking that every value has the declared type."""
    declared = get_type_hints(kind)
    for name, value in table.items():
        if not _has_type(value, declared[name]):
            raise TypeError(f"{name}: is a {type(value).__name__}")
    return kind(**table)


def _has_type(value: Any, kind: Any) -> bool:
    if isinstance(kind, UnionType):
        return any(_has_type(value, one) for one in get_args(kind))
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_has_type(one, get_args(kind)[0]) for one in value)
    if kind in (int, float):
        return type(value) in (int, kind) and math.isfinite(value)
    return isinstance(value, kind)
