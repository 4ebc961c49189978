"""Session and result files. No other room imports h5py.

``data/schema/README.md`` describes the format. `open_session` reads sessions and `SessionWriter` writes them;
`read_archive` and `write_archive` do the same for results (calibrations, force maps).
"""

from .archive import Archive, ArchiveReader, ArchiveWriter, open_archive, read_archive, write_archive
from .errors import SessionError
from .facts import SessionFacts, StreamFacts
from .hdf5.storage import file_hash, replacing, require_no_session
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
