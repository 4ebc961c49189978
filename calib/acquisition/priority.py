"""Real-time priority: threads that are woken at once, however busy the machine is.

An ordinary thread waits for its turn, on a busy machine for some milliseconds at the 99th percentile. Threads under
POSIX `SCHED_FIFO` go before all ordinary ones. Linux gives them at most 95 % of a core unless told otherwise.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_TASKS = Path("/proc/self/task")


class PriorityError(OSError):
    """No real-time priority for this user or on this system."""


@contextmanager
def real_time(wanted: bool = True) -> Iterator[None]:
    """While this lasts, the threads of this process and those that they start go before all ordinary ones.

    Raises:
        PriorityError: if the system refuses; nothing is changed then.
    """
    before = _raised() if wanted else {}
    try:
        yield
    finally:
        _set(before)


def refusal() -> str | None:
    """Why `real_time` is not to be had here; None where it is."""
    try:
        with real_time():
            return None
    except PriorityError as error:
        return str(error)


Policy = tuple[int, "os.sched_param"]


def _raised() -> dict[int, Policy]:
    """What the threads had before."""
    if not (hasattr(os, "sched_setscheduler") and _TASKS.is_dir()):
        raise PriorityError("real-time priority is to be had on Linux only; leave --realtime out")
    lowest = os.SCHED_FIFO, os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO))
    before: dict[int, Policy] = {}
    for task in map(int, os.listdir(_TASKS)):
        with suppress(ProcessLookupError):  # it has just ended
            before[task] = os.sched_getscheduler(task), os.sched_getparam(task)
    try:
        _set(dict.fromkeys(before, lowest))
    except PermissionError as error:
        user = os.environ.get("USER", "USER")
        raise PriorityError(
            "this user may not have real-time priority: leave --realtime out, or allow it, by the line "
            f"'{user} - rtprio 1' in /etc/security/limits.conf and a new login, or by CAP_SYS_NICE"
        ) from error
    return before


def _set(policies: dict[int, Policy]) -> None:
    for task, (policy, parameters) in policies.items():
        with suppress(ProcessLookupError):
            os.sched_setscheduler(task, policy, parameters)
