"""How do I write recordings of my own as a session? Streams with their own clocks, in SI units, block by block."""

import tempfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

import calib
from calib.session import SessionFacts, StreamFacts

rng = np.random.default_rng(0)
folder = Path(tempfile.mkdtemp())
facts = SessionFacts(epoch=datetime(2026, 1, 1, tzinfo=UTC), title="two presses by hand", license="CC0-1.0")

with calib.SessionWriter(folder / "session.h5", facts) as writer:
    writer.add_stream("pressure", StreamFacts("pressure", units="Pa", channels=2, rate_hz=100))
    writer.add_stream("force", StreamFacts("force", units="N", channels=1, rate_hz=50))
    for second in range(10):  # as it arrives; the file appears when the block ends
        t = second + np.arange(100) / 100  # s
        load = 10 * np.exp(-((t - 3) ** 2)) + 15 * np.exp(-((t - 7) ** 2))  # N
        pads = np.stack([400 * load, 100 * load], 1) + rng.normal(0, 5, (100, 2))  # Pa
        writer.append("pressure", (1e9 * t).astype(np.int64), pads)
        writer.append("force", (1e9 * t[::2]).astype(np.int64), load[::2])

with calib.open_session(folder / "session.h5") as session:
    pressures, forces = (session.streams[name].read() for name in ("pressure", "force"))
    for name, stream in session.streams.items():
        print(f"{name}: {len(stream.read())} samples")
print(f"largest force {forces.max():.1f} N, at {pressures.max():.0f} Pa")
