"""Record sessions from devices: what devices send becomes a session file, and nothing that arrived is lost.

From the wire to the file: `wire`, `framing`, `encoding` and `decoding` (messages), `sequence` (order of frames),
`sources` (TCP, serial, replay), `intake` and `recorder` (threads that only move bytes), `journal` and `records` (what
survives a crash), `clock` (device time to host time), `survey` and `conversion` (journal to session). `priority` gives
threads real-time scheduling, and `device` simulates a skin that uses the same wire format.
"""

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .conversion import convert_journal
    from .device import SimulatedDevice
    from .journal import JournalError
    from .plan import PlanError, RecordingPlan, StreamPlan
    from .planning import plan_recording
    from .priority import PriorityError, real_time
    from .recorder import RecordError, StopRequest, record_session, session_journal
    from .sources import Source, SourceError
    from .summary import RecordingSummary, StreamSummary

__getattr__, __all__ = lazy_names(
    __name__,
    {
        "conversion": "convert_journal",
        "device": "SimulatedDevice",
        "journal": "JournalError",
        "plan": "PlanError RecordingPlan StreamPlan",
        "planning": "plan_recording",
        "priority": "PriorityError real_time",
        "recorder": "RecordError StopRequest record_session session_journal",
        "sources": "Source SourceError",
        "summary": "RecordingSummary StreamSummary",
    },
)
