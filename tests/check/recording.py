"""A recording in memory, of which a test changes one thing before it is written."""

from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from calib.session import PressTable, Session, SessionFacts, SessionWriter, StreamFacts

SECOND = 1_000_000_000


@dataclass(frozen=True)
class Samples:
    """One stream: facts, time stamps (n,) ns, values (n, channels), and status flags (n,)."""

    facts: StreamFacts
    time: np.ndarray
    values: np.ndarray
    status: np.ndarray | None = None

    def held(self, values):
        """The same times with other values."""
        return replace(self, facts=replace(self.facts, channels=values.shape[1]), values=values)

    def at(self, time):
        """The same values at other times."""
        return replace(self, time=np.asarray(time).astype(np.int64))


@dataclass(frozen=True)
class Recording:
    """All that a session file holds."""

    facts: SessionFacts
    streams: dict[str, Samples]
    presses: PressTable | None

    @classmethod
    def of(cls, session: Session) -> "Recording":
        """What a session holds, without its truth, as if it had been measured."""
        names = ("title", "skin_name", "skin_toml", "pattern", "current", "frequency", "offset")
        facts = SessionFacts(
            epoch=datetime.fromisoformat(session.epoch), **{name: getattr(session, name) for name in names}
        )
        streams = {
            name: Samples(
                StreamFacts(s.variable, units=s.unit, channels=s.channels, rate_hz=s.nominal_rate),
                np.asarray(s.time),
                s.read(),
            )
            for name, s in session.streams.items()
        }
        return cls(facts, streams, session.presses)

    def write(self, path):
        """Write the session file, in the place of an earlier one."""
        Path(path).unlink(missing_ok=True)
        with SessionWriter(path, self.facts) as writer:
            for name, samples in self.streams.items():
                writer.add_stream(name, samples.facts)
                writer.append(name, samples.time, samples.values, samples.status)
            if self.presses is not None:
                writer.set_presses(self.presses)
        return path

    # --- changes -------------------------------------------------------------------------------

    def with_stream(self, name: str, samples: Samples) -> "Recording":
        """With one stream exchanged for another, or added."""
        return replace(self, streams=self.streams | {name: samples})

    def without(self, name: str) -> "Recording":
        """Without one stream."""
        return replace(self, streams={k: v for k, v in self.streams.items() if k != name})

    def values(self, name: str) -> np.ndarray:
        """Values of one stream (n, channels)."""
        return self.streams[name].values

    def change(self, name: str, values: Any) -> "Recording":
        """With other values in one stream."""
        return self.with_stream(name, self.streams[name].held(np.asarray(values)))

    def at(self, name: str, time: Any) -> "Recording":
        """With other time stamps in one stream."""
        return self.with_stream(name, self.streams[name].at(time))

    def pressed(self, **columns: Any) -> "Recording":
        """With other columns in the table of presses."""
        assert self.presses is not None
        return replace(self, presses=replace(self.presses, **columns))
