"""Which sessions a calibration was fitted to or moved by: each once, and none of them as a test."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from ..session import Session, SessionError

if TYPE_CHECKING:
    from .calibration import Calibration

FITTED_NOTE = "the calibration was fitted to this session, so that the errors on other sessions are larger"
SAME_NOTE = "the calibration was fitted to this session, which tells nothing of what has changed since"
MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # of the hash: an odd number of mixed bits, 2^64 over the golden ratio
RUN_ROWS = 16  # rows of a stream in a run that is looked for in another session
RUN_CHANNELS = 4  # first channels that are compared: rounding errors of many would leave no run equal
KEPT_BITS = 14  # of each number, so that a copy in float32 or with few decimals in a text is known
MAX_EQUAL_RUNS = 0.5  # share of runs of a session's streams that another recording may hold
AGREEMENT = 1e-4  # relative difference of forces and pressures that are one and the same measurement
MAX_EQUAL_PRESSES = 0.5  # share of a session's presses that a calibration may hold


def require_each_once(sessions: Sequence[Session]) -> None:
    """Refuse a recording that is given twice, whose copy would be held out by itself.

    Copies have the file, the identity, or most of the samples of another session: written again under another identity,
    or imported again from a log that lacks some rows.

    Raises:
        SessionError: naming both files.
    """
    known: dict[str, Session] = {}
    for session in sessions:
        for mark in {session.hash, session.session_id}:
            if mark in known:
                other = known[mark].name
                raise SessionError(
                    f"{session.name}: is the recording of {other} again (session_id {session.session_id}); "
                    "give each recording once"
                )
        known |= {session.hash: session, session.session_id: session}
    forces = {id(session): _runs(session, "force") for session in sessions if len(sessions) > 1}
    for one, two in combinations(sessions, 2):
        if _mostly_equal(forces[id(one)], forces[id(two)]) and _same_streams(one, two):
            raise SessionError(
                f"{two.name}: holds the samples of {one.name} again under another session_id; give each recording once"
            )


def _same_streams(one: Session, two: Session) -> bool:
    """Whether all streams that two sessions share hold the same samples, times apart."""
    shared = one.streams.keys() & two.streams.keys() & {"eit", "pressure"}
    return all(_mostly_equal(_runs(one, name), _runs(two, name)) for name in shared)


def _mostly_equal(one: np.ndarray, two: np.ndarray) -> bool:
    """Whether the shorter of two stretches of runs is for the most part within the other one."""
    short, long = sorted((one, two), key=len)
    return len(short) > 0 and float(np.isin(short, long).mean()) > MAX_EQUAL_RUNS


def _runs(session: Session, name: str) -> np.ndarray:
    """A number for each run of consecutive rows of a stream that differ from one another; rows at rest may be equal."""
    if name not in session.streams:
        return np.empty(0, np.uint64)
    stream = session.stream(name)
    rows = np.concatenate([np.empty(0, np.uint64), *(_marks(values) for _, _, values in stream.blocks())])
    count = max(len(rows) - RUN_ROWS + 1, 0)
    changes = np.concatenate([[0], np.cumsum(rows[1:] != rows[:-1])]) if len(rows) else np.empty(0, int)
    runs = np.zeros(count, np.uint64)
    for row in range(RUN_ROWS):
        runs = runs * MULTIPLIER + rows[row : row + count]
    varied: np.ndarray = runs[changes[RUN_ROWS - 1 :] - changes[:count] >= RUN_ROWS // 2]
    return varied


def _marks(values: np.ndarray) -> np.ndarray:
    """A number for each row (n, channels), which tells the leading bits of its first channels."""
    mantissa, exponent = np.frexp(np.nan_to_num(values[:, :RUN_CHANNELS]))
    leading = np.ldexp(np.round(np.ldexp(mantissa, KEPT_BITS)), exponent).astype(np.float64)
    bits = np.ascontiguousarray(leading + 0.0).view(np.uint64)  # + 0.0: there is no negative zero
    marks = np.zeros(len(values), np.uint64)
    for column in bits.T:
        mixed = (marks ^ column) * MULTIPLIER
        marks = mixed ^ (mixed >> np.uint64(29))
    return marks


def holds_presses(calibration: "Calibration", force: np.ndarray, pressure: np.ndarray) -> bool:
    """Whether most presses, of forces (n,) N and readings (n, pads) Pa, are among those of a calibration.

    A recording that was written again under another identity is known by it.
    """
    fitted = np.column_stack((calibration.evaluation.force, calibration.evaluation.pressure))
    new = np.column_stack((force, calibration.own_pressures(pressure)))
    size = np.abs(fitted).max(initial=0.0, axis=0)
    equal = [bool((np.abs(fitted - row) <= AGREEMENT * size).all(1).any()) for row in new]
    return len(new) > 0 and float(np.mean(equal)) > MAX_EQUAL_PRESSES


def is_fitted(provenance: Mapping[str, str], session: Session) -> bool:
    """Whether a calibration of this provenance was fitted to the very file of a session, or moved by it."""
    return any(_is_listed(provenance, name, session) for name in ("sessions", "recalibrations"))


def is_calibrated_from(provenance: Mapping[str, str], session: Session) -> bool:
    """Whether a calibration of this provenance was fitted to the very file of a session."""
    return _is_listed(provenance, "sessions", session)


def require_not_moved_by(provenance: Mapping[str, str], session: Session) -> None:
    """Refuse a session by which a calibration was moved before: counted twice, it would seem surer than it is.

    Raises:
        SessionError: naming the session.
    """
    if _is_listed(provenance, "recalibrations", session):
        raise SessionError(f"{session.name}: has moved this calibration before; give a recording that is new")


def _is_listed(provenance: Mapping[str, str], name: str, session: Session) -> bool:
    return any(line.startswith(f"{session.hash}  ") for line in provenance.get(name, "").splitlines())
