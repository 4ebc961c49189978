"""Place frames by their sequence numbers: in order, after a gap, repeated, late, or after a restart of the device.

Not every device counts its frames as it should: numbers may stand still, fall, or wrap at fewer than 32 bits. A frame
that the device took later than the last one is new whatever its number says, and is kept as miscounted.
"""

import enum
from typing import NamedTuple

REORDER_WINDOW = 64  # a frame at most this far behind was repeated, or overtaken on its way
MAX_GAP = 1 << 20  # a larger gap means that the device has restarted, not that so many frames were lost


class SequencePlace(enum.Enum):
    """Place of a frame in the sequence."""

    NEXT = "next"
    GAP = "after a gap"
    RESTART = "after a restart of the device"
    REPEATED = "repeated"
    LATE = "late"
    SUSPECT = "out of sequence"  # accepted if the next frame follows it
    MISCOUNTED = "new, with a number that does not count up"

    @property
    def kept(self) -> bool:
        """Whether the frame belongs in the recording."""
        return self not in (SequencePlace.REPEATED, SequencePlace.LATE, SequencePlace.SUSPECT)


class SequenceState(NamedTuple):
    """The last number that was kept, and a number far from it that awaits confirmation by the next frame."""

    last: int | None = None
    suspect: int | None = None


def place_frame(state: SequenceState, seq: int, newer: bool = False) -> tuple[SequenceState, SequencePlace, int]:
    """Place the frame `seq`.

    ``newer`` says that the device took the frame later than the last one that was kept. Returns the new state, the
    place, and the number of frames missing before the frame.
    """
    if state.last is None:
        return SequenceState(seq), SequencePlace.NEXT, 0
    ahead = (seq - state.last) % 2**32
    if 1 <= ahead <= MAX_GAP:
        return SequenceState(seq), SequencePlace.NEXT if ahead == 1 else SequencePlace.GAP, ahead - 1
    if newer:
        return SequenceState(seq), SequencePlace.MISCOUNTED, 0
    if ahead == 0:
        return state, SequencePlace.REPEATED, 0
    if ahead >= 2**32 - REORDER_WINDOW:
        return state, SequencePlace.LATE, 0
    if state.suspect is not None and 1 <= (seq - state.suspect) % 2**32 <= REORDER_WINDOW:
        return SequenceState(seq), SequencePlace.RESTART, (seq - state.suspect) % 2**32
    return SequenceState(state.last, seq), SequencePlace.SUSPECT, 0
