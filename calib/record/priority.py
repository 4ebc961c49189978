"""Real-time scheduling (SCHED_FIFO), so that threads run promptly on a busy machine.

An ordinary thread on a busy machine waits some milliseconds for a processor, at the 99th percentile. Threads under
POSIX `SCHED_FIFO` run before all ordinary ones. By default Linux limits them to 95 % of a core.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

TASKS = Path("/proc/self/task")


class PriorityError(OSError):
    """The system does not allow real-time scheduling for this user."""


@contextmanager
def real_time(wanted: bool = True) -> Iterator[None]:
    """Schedule the threads of this process, and those that they start, before all ordinary ones within this context.

    Args:
        wanted: False: leave the scheduling as it is.

    Raises:
        PriorityError: if the system refuses; the scheduling is then unchanged.

    Example:
        from calib.record import PriorityError, real_time

        try:
            with real_time():  # around record_session: no frame waits for other programs
                pass
        except PriorityError as error:
            print(error)
    """
    before = _raise_priority() if wanted else {}
    try:
        yield
    finally:
        _set_policies(before)


def refusal() -> str | None:
    """The reason why `real_time` is not available here, or None if it is."""
    try:
        with real_time():
            return None
    except PriorityError as error:
        return str(error)


Policy = tuple[int, "os.sched_param"]


def _raise_priority() -> dict[int, Policy]:
    """Give all threads of this process real-time scheduling; returns their policies before."""
    if not (hasattr(os, "sched_setscheduler") and TASKS.is_dir()):
        raise PriorityError("real-time scheduling is available on Linux only; leave out --realtime")
    lowest = os.SCHED_FIFO, os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO))
    before: dict[int, Policy] = {}
    for task in map(int, os.listdir(TASKS)):
        with suppress(ProcessLookupError):  # the thread has just ended
            before[task] = os.sched_getscheduler(task), os.sched_getparam(task)
    try:
        _set_policies(dict.fromkeys(before, lowest))
    except PermissionError as error:
        user = os.environ.get("USER", "USER")
        raise PriorityError(
            "this user may not use real-time scheduling: leave out --realtime, or allow it by the line "
            f"'{user} - rtprio 1' in /etc/security/limits.conf and a new login, or by CAP_SYS_NICE"
        ) from error
    return before


def _set_policies(policies: dict[int, Policy]) -> None:
    for task, (policy, parameters) in policies.items():
        with suppress(ProcessLookupError):
            os.sched_setscheduler(task, policy, parameters)
