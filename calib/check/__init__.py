"""Checks of a recording for `jaxeit check`: what is wrong, where, and what to do."""

from .acceptance import RecordingError, accept
from .eit.reading_order import transfer_matrix
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
