"""`jaxeit check`: what is wrong with a recording, where, and what to do about it."""

from calib.check.order import transfer_matrix
from calib.check.report import ChannelTable, CheckReport, Finding, Severity, render, to_json
from calib.check.verdict import check_session

__all__ = [
    "ChannelTable",
    "CheckReport",
    "Finding",
    "Severity",
    "check_session",
    "render",
    "to_json",
    "transfer_matrix",
]
