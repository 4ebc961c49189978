"""Session and result files. No other room imports h5py.

``data/schema/README.md`` describes the format. `open_session` reads sessions and `SessionWriter` writes them;
`read_archive` and `write_archive` do the same for results (calibrations, force maps).

Example:
    from datetime import UTC, datetime

    import numpy as np

    import calib
    from calib.session import SessionFacts, Status, StreamFacts

    facts = SessionFacts(epoch=datetime(2026, 1, 1, tzinfo=UTC), title="two pads", license="CC0-1.0")
    time = 10_000_000 * np.arange(100)  # ns
    with calib.SessionWriter("written.h5", facts) as writer:  # the file appears when the block ends
        writer.add_stream("pressure", StreamFacts("pressure", units="Pa", channels=2, rate_hz=100))
        status = np.where(np.arange(100) == 30, Status.saturated, 0)
        writer.append("pressure", time, np.outer(np.arange(100.0), [10.0, 2.0]), status=status)
        writer.add_events(time[50:51], [1], ["touched"])

    with calib.open_session("written.h5") as session:
        stream = session.stream("pressure")
        print(stream.shape, stream.unit, stream.read(10, 12), session.events.label)  # a piece, in SI
        print(Status(int(stream.status()[30])))  # why a sample is doubtful
    print(calib.session.file_hash("written.h5")[:12])
"""

from .archive import Archive, ArchiveReader, ArchiveWriter, open_archive, read_archive, write_archive
from .errors import SessionError
from .facts import SessionFacts, StreamFacts
from .outputs import file_hash, replacing, require_no_session
from .reader import Session, open_session
from .stream import Stream
from .tables import ClockTable, Events, PressTable, Status
from .writer import SessionWriter

__all__ = [
    "Archive",
    "ArchiveReader",
    "ArchiveWriter",
    "ClockTable",
    "Events",
    "PressTable",
    "Session",
    "SessionError",
    "SessionFacts",
    "SessionWriter",
    "Status",
    "Stream",
    "StreamFacts",
    "file_hash",
    "open_archive",
    "open_session",
    "read_archive",
    "replacing",
    "require_no_session",
    "write_archive",
]
