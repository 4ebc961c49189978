"""`jaxeit check`: what is wrong with a recording, where, and what to do about it."""

from .acceptance import RecordingError, accept
from .reading_order import transfer_matrix
from .report import ChannelTable, CheckReport, Finding, Severity, to_json
from .session import check_session
from .text import render

__all__ = [
    "ChannelTable",
    "CheckReport",
    "Finding",
    "RecordingError",
    "Severity",
    "accept",
    "check_session",
    "render",
    "to_json",
    "transfer_matrix",
]
