"""All comparisons of the force of a log with its channels."""

from collections.abc import Iterator, Mapping

from ..report import Finding
from ..streams.statistics import StreamStatistics
from .blocks import log_blocks, signal_name
from .copies import log_copy_finding, same_column_finding
from .following import standstill_findings, unrelated_finding
from .gains import gain_findings


def log_findings(statistics: Mapping[str, StreamStatistics], simulated: bool) -> Iterator[Finding]:
    """What cannot be true of the force and the channels of a log; a simulation may be free of noise, or ideal."""
    signal = signal_name(statistics.keys())
    if not signal or "force" not in statistics:
        return
    if not simulated:
        yield from log_copy_finding(statistics, signal)
    log = log_blocks(statistics)
    if log is None:
        return
    one = [] if simulated else [*same_column_finding(log)]
    wrong = one or [*unrelated_finding(log)]
    yield from wrong
    if wrong:  # what is compared below would be noise
        return
    yield from standstill_findings(log)
    yield from gain_findings(log)
