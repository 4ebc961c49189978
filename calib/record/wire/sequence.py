"""Place frames by their sequence numbers: in order, after a gap, repeated, late, or after a restart of the device."""

import enum
from typing import NamedTuple

REORDER_WINDOW = 64  # a frame at most this far behind was repeated, or overtaken on its way
MAX_GAP = 1 << 20  # a larger gap means that the device has restarted, not that so many frames were lost


class SequencePlace(enum.Enum):
    """Place of a frame in the sequence; frames of the first three kinds are kept."""

    NEXT = "next"
    GAP = "after a gap"
    RESTART = "after a restart of the device"
    REPEATED = "repeated"
    LATE = "late"
    SUSPECT = "out of sequence"  # accepted if the next frame follows it

    @property
    def kept(self) -> bool:
        """Whether the frame belongs in the recording."""
        return self in (SequencePlace.NEXT, SequencePlace.GAP, SequencePlace.RESTART)


class SequenceState(NamedTuple):
    """The last number that was kept, and a number far from it that awaits confirmation by the next frame."""

    last: int | None = None
    suspect: int | None = None


def place_frame(state: SequenceState, seq: int) -> tuple[SequenceState, SequencePlace, int]:
    """Place the frame `seq`. Returns the new state, the place, and the number of frames missing before it."""
    if state.last is None:
        return SequenceState(seq), SequencePlace.NEXT, 0
    ahead = (seq - state.last) % 2**32
    if 1 <= ahead <= MAX_GAP:
        return SequenceState(seq), SequencePlace.NEXT if ahead == 1 else SequencePlace.GAP, ahead - 1
    if ahead == 0:
        return state, SequencePlace.REPEATED, 0
    if ahead >= 2**32 - REORDER_WINDOW:
        return state, SequencePlace.LATE, 0
    if state.suspect is not None and 1 <= (seq - state.suspect) % 2**32 <= REORDER_WINDOW:
        return SequenceState(seq), SequencePlace.RESTART, (seq - state.suspect) % 2**32
    return SequenceState(state.last, seq), SequencePlace.SUSPECT, 0
