"""Findings from the comparison of the frames with a uniform sheet: the order of the readings, and their amplitude."""

from collections.abc import Iterator

from ..report import Finding, Severity
from .reading_order import OrderCheck

WHERE = "/streams/eit"
AMPLITUDE_RATIO_RANGE = 0.2, 5.0  # of measured over modelled voltage: outside it, a unit or the sheet is wrong
AMPLITUDE_RATIO_OF_OTHER_ORDERS = 0.03, 30.0  # the same for readings that do not look like the model
MIN_CORRELATION = 0.9  # with the model: readings below it do not look like this skin


def order_findings(order: OrderCheck) -> Iterator[Finding]:
    """A wrong order of the readings or the electrodes, or readings that do not look like the skin."""
    if order.claimed:
        same = f" (or, with the same readings: {'; '.join(order.same)})" if order.same else ""
        what = (
            f"the order looks wrong: {order.what}{same}. Correlation with the model is "
            f"{order.as_is:.3f} as recorded and {order.best:.3f} in this order"
        )
        yield Finding(Severity.ERROR, WHERE, what, order.remedy)
    elif order.as_is < MIN_CORRELATION:
        what = (
            f"the readings do not look like this skin: correlation with its model {order.as_is:.2f}, "
            f"and no simple reordering explains it (best {order.best:.2f})"
        )
        remedy = "compare positions and numbering of the electrodes in the skin's file with the hardware"
        yield Finding(Severity.WARNING, WHERE, what, remedy)


def amplitude_findings(order: OrderCheck) -> Iterator[Finding]:
    """An amplitude that a skin of the described sheet resistance cannot have."""
    low, high = AMPLITUDE_RATIO_RANGE if order.as_is >= MIN_CORRELATION else AMPLITUDE_RATIO_OF_OTHER_ORDERS
    if order.as_is > 0 and not low < order.scale < high:
        parts = "unit (V, mV), gain, current or sheet_resistance is wrong"
        what = f"the amplitude is {order.scale:.3g} times the model's: {parts}"
        yield Finding(Severity.WARNING, WHERE, what, "correct the unit at import, current or sheet_resistance")
