"""What is to be recorded: the session's facts and its streams, also as the text a journal begins with."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from typing import Any

import numpy as np

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
        if not np.isfinite(numbers).all() or self.rate < 0 or self.tick <= 0:
            raise PlanError(f"{self.name}: rate {self.rate} Hz, tick {self.tick} s; give numbers above zero")
        self.layout  # noqa: B018  refuses channels, scale and number

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
        moment = datetime.fromisoformat(self.epoch)
        if moment.tzinfo is None:
            raise PlanError(f"epoch {self.epoch}: has no time zone")
        eit = [s.channels for s in self.streams if s.name == "eit"]
        if eit and (self.pattern is None or len(self.pattern) != eit[0]):
            rows = "no pattern" if self.pattern is None else f"a pattern of {len(self.pattern)} rows"
            raise PlanError(f"eit: {eit[0]} readings beside {rows}; give the skin whose protocol is measured")

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
        table["streams"] = tuple(StreamPlan(**stream) for stream in table["streams"])
        for name in ("pattern", "offset"):
            table[name] = table[name] and tuple(tuple(v) if isinstance(v, list) else v for v in table[name])
        return Plan(**{f.name: table[f.name] for f in fields(Plan)})
    except (KeyError, TypeError, AttributeError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise JournalError(f"journal: its description cannot be read ({error})") from error
