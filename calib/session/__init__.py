"""Session and result files: the only package that imports h5py.

The format is described in ``data/schema/README.md``. `open_session` reads, `SessionWriter` writes;
`read_archive` and `write_archive` do the same for results (calibrations, force maps).
"""

from calib.session.archive import (
    Archive,
    ArchiveReader,
    ArchiveWriter,
    open_archive,
    read_archive,
    write_archive,
)
from calib.session.model import ClockTable, Events, PressTable, SessionError, Status
from calib.session.reader import Session, Stream, open_session
from calib.session.storage import file_hash, replacing
from calib.session.writer import SessionWriter

__all__ = [
    "Archive",
    "ArchiveReader",
    "ArchiveWriter",
    "ClockTable",
    "Events",
    "PressTable",
    "Session",
    "SessionError",
    "SessionWriter",
    "Status",
    "Stream",
    "file_hash",
    "open_archive",
    "open_session",
    "read_archive",
    "replacing",
    "write_archive",
]
