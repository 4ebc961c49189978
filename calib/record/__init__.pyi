"""Names of `calib.record` and their modules, from which `__init__.py` imports them on first use."""

from .device import SimulatedDevice as SimulatedDevice, frame_packets as frame_packets
from .journal.conversion import convert_journal as convert_journal
from .journal.file import JournalError as JournalError
from .plan import PlanError as PlanError, RecordingPlan as RecordingPlan, StreamPlan as StreamPlan
from .planning import plan_recording as plan_recording
from .priority import PriorityError as PriorityError, real_time as real_time
from .recorder import (
    RecordError as RecordError,
    StopRequest as StopRequest,
    record_session as record_session,
    session_journal as session_journal,
)
from .sources import Source as Source, SourceError as SourceError
from .summary import RecordingSummary as RecordingSummary, StreamSummary as StreamSummary
