"""Checks of a recording for `jaxeit check`: what is wrong, where, and what to do.

Example:
    import jax

    import calib
    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    with calib.open_session("session.h5") as session:
        report = calib.check_session(session)
    print(calib.check.render(report))  # what `jaxeit check` prints
    for finding in report.findings:
        if finding.severity >= calib.check.Severity.WARNING:
            print(finding)
    print(len(calib.check.to_json(report)), "bytes for other programs")
"""

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
