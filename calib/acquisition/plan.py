"""What is to be recorded: the session's facts and its streams, also as the text a journal begins with."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from calib.session.guard import MAX_ATTRIBUTE_BYTES

from .journal import JournalError
from .wire import Layout

_FORMAT = "jaxeit-journal"


class PlanError(ValueError):
    """A recording that cannot be planned."""


@dataclass(frozen=True)
class Kind:
    """What streams of one name hold: variable, unit, wire number, largest possible magnitude in SI."""

    variable: str
    units: str
    number: int
    limit: float


KINDS: Mapping[str, Kind] = {
    "eit": Kind("voltage", "V", 1, 1e3),
    "pressure": Kind("pressure", "Pa", 2, 1e7),
    "force": Kind("force", "N", 3, 1e6),
    "stage": Kind("position", "m", 4, 1e2),
    "temperature": Kind("temperature", "K", 5, 1e4),
    "barometer": Kind("pressure", "Pa", 6, 1e7),
}


def _check_texts(plan: Any) -> None:
    """Raises `PlanError` for a field that is a text and fits no attribute of a session."""
    for field in fields(plan):
        text = getattr(plan, field.name)
        raw = text.encode(errors="replace") if isinstance(text, str) else b""
        if len(raw) > MAX_ATTRIBUTE_BYTES or b"\0" in raw or (raw and raw.decode() != text):
            limit = f"use at most {MAX_ATTRIBUTE_BYTES:,} bytes of Unicode, none of them zero"
            raise PlanError(f"{field.name}: is a text that cannot be stored; {limit}")


@dataclass(frozen=True)
class StreamPlan:
    """One stream: what it holds, and how its device sends it.

    ``rate`` in Hz, 0 if not known; values in SI are ``scale * sent + offset``; ``tick`` in s; ``number`` is the
    stream's on the wire; ``transport`` tells where it came from.
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
        if self.name not in KINDS:
            raise PlanError(f"stream {self.name!r} is not known; there are {', '.join(KINDS)}")
        if self.number < 0:
            object.__setattr__(self, "number", self.kind.number)
        numbers = (self.rate, self.scale, self.offset, self.tick)
        if not np.isfinite(numbers).all() or self.rate < 0 or not 1e-12 <= self.tick < 1e3:
            said = f"rate {self.rate} Hz, tick {self.tick} s"
            raise PlanError(f"{self.name}: {said}; give numbers above zero, and a tick of 1e-12 to 1e3 s")
        self.layout  # noqa: B018  refuses channels, scale and number
        _check_texts(self)

    @property
    def kind(self) -> Kind:
        """Variable, unit and limit of its values."""
        return KINDS[self.name]

    @property
    def layout(self) -> Layout:
        """What its frames must look like."""
        return Layout(self.number, self.channels, self.scale, self.kind.limit)

    def in_si(self, values: np.ndarray) -> np.ndarray:
        """Values as sent -> f8 in SI; the lowest count means missing."""
        out = values.astype(np.float64)
        if values.dtype.kind == "i":
            out[values == np.iinfo(values.dtype).min] = np.nan
        return out * self.scale + self.offset


@dataclass(frozen=True)
class Plan:
    """A recording: facts for the session file, its time axis, and its streams.

    ``pattern`` (M, 4), ``current`` (A), ``frequency`` (Hz) and ``offset`` (M,) s are the EIT protocol, or None.
    ``epoch`` is an ISO time with zone, taken when the clock that is never set showed ``host_epoch`` ns.
    """

    streams: tuple[StreamPlan, ...]
    epoch: str
    host_epoch: int
    session_id: str
    title: str = ""
    skin_name: str = ""
    skin_toml: str = ""
    pattern: tuple[tuple[int, ...], ...] | None = None
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
        self._fits_a_session()
        eit = [s.channels for s in self.streams if s.name == "eit"]
        if eit and (self.pattern is None or len(self.pattern) != eit[0]):
            rows = "no pattern" if self.pattern is None else f"a pattern of {len(self.pattern)} rows"
            raise PlanError(f"eit: {eit[0]} readings beside {rows}; give the skin whose protocol is measured")

    def _fits_a_session(self) -> None:
        """Or the recording would be made in vain."""
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
        """As the first record of a journal holds it."""
        return json.dumps({"format": _FORMAT, "version": 1, **asdict(self)}).encode()


def plan_from_json(text: bytes) -> Plan:
    """The plan of a journal; raises `JournalError` for what is none."""
    try:
        table: dict[str, Any] = json.loads(text)
        if table.pop("format") != _FORMAT or table.pop("version") != 1:
            raise JournalError("journal: of another format or version; use the jaxeit that wrote it")
        table["streams"] = tuple(_typed(StreamPlan, stream) for stream in table["streams"])
        for name in ("pattern", "offset"):
            table[name] = table[name] and tuple(tuple(v) if isinstance(v, list) else v for v in table[name])
        return _typed(Plan, {f.name: table[f.name] for f in fields(Plan)})
    except JournalError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        why = " ".join(str(error).split())[:200]
        raise JournalError(f"journal: its description cannot be read ({why})") from error


def _typed(kind: type, table: dict[str, Any]) -> Any:
    """An object of fields whose types are those it declares."""
    declared = get_type_hints(kind)
    for name, value in table.items():
        if not _is(value, declared[name]):
            raise TypeError(f"{name}: is a {type(value).__name__}")
    return kind(**table)


def _is(value: Any, kind: Any) -> bool:
    if isinstance(kind, UnionType):
        return any(_is(value, one) for one in get_args(kind))
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_is(one, get_args(kind)[0]) for one in value)
    if kind in (int, float):
        return type(value) in (int, kind) and math.isfinite(value)
    return isinstance(value, kind)
