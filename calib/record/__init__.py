"""Record sessions from devices: what devices send becomes a session file, and nothing that arrived is lost.

From the wire to the file: `wire` (messages and the order of frames), `sources` (TCP, serial, replay), `intake` and
`recorder` (threads that only move bytes), `journal` (the file that survives a crash, and its conversion to a session),
`clock` (device time to host time). `priority` gives threads real-time scheduling, and `device` simulates a skin that
uses the same wire format.
"""

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .device import SimulatedDevice
    from .journal.conversion import convert_journal
    from .journal.file import JournalError
    from .plan import PlanError, RecordingPlan, StreamPlan
    from .planning import plan_recording
    from .priority import PriorityError, real_time
    from .recorder import RecordError, StopRequest, record_session, session_journal
    from .sources import Source, SourceError
    from .summary import RecordingSummary, StreamSummary

__getattr__, __all__ = lazy_names(
    __name__,
    {
        "journal.conversion": "convert_journal",
        "device": "SimulatedDevice",
        "journal.file": "JournalError",
        "plan": "PlanError RecordingPlan StreamPlan",
        "planning": "plan_recording",
        "priority": "PriorityError real_time",
        "recorder": "RecordError StopRequest record_session session_journal",
        "sources": "Source SourceError",
        "summary": "RecordingSummary StreamSummary",
    },
)
