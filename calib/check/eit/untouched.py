"""Compare a frame of the untouched skin with the model of the skin, as `check_session` does for a recording."""

import numpy as np
from jaxtyping import Bool, Float

import jaxeit as je

from ..report import Finding, Severity
from .order_findings import AMPLITUDE_RATIO_OF_OTHER_ORDERS, WHERE, amplitude_findings, order_findings
from .reading_order import check_order, predict_readings, transfer_matrix
from .readings import MIN_SOUND_READINGS


class UntouchedCheck:
    """Compares frames with the uniform sheet of a skin: order, signs and amplitude of the readings.

    The model is solved once, which compiles programs. A frame that resembles it costs a product; for one that does not,
    many orders are tried, some tenths of a second.

    Raises:
        ValueError: if the skin cannot be meshed.
    """

    def __init__(self, skin: je.Skin):
        self._skin, self._transfer = skin, transfer_matrix(skin)

    def __call__(
        self, untouched: Float[np.ndarray, " readings"], used: Bool[np.ndarray, " readings"]
    ) -> tuple[Finding, ...]:
        """What is wrong with a mean frame without contact, V; nothing where too few readings are used and finite."""
        good = used & np.isfinite(untouched)
        if good.sum() < max(MIN_SOUND_READINGS, len(good) // 4):
            return ()
        scan = self._skin.protocol
        expected = scan.current * predict_readings(self._transfer, scan.pattern, scan.mixing)
        sizes = [float(np.sqrt(np.mean(part[good] ** 2))) for part in (untouched, expected)]
        if sizes[0] < AMPLITUDE_RATIO_OF_OTHER_ORDERS[0] * sizes[1]:
            return (_about_zero(*sizes),)
        order = check_order(
            untouched,
            good,
            scan.pattern,
            self._transfer,
            current=scan.current,
            positions=self._skin.electrode_positions,
            mixing=scan.mixing,
        )
        return (*order_findings(order), *amplitude_findings(order))


def _about_zero(measured: float, expected: float) -> Finding:
    """Readings much smaller than those of the model; root mean squares in V."""
    what = (
        f"the readings of the untouched skin are about zero: {1e3 * measured:.2g} mV (root mean square), where the "
        f"model expects {1e3 * expected:.2g} mV. Order and signs were not checked"
    )
    remedy = "send the voltages themselves without a reference frame subtracted, in V; check the drive current"
    return Finding(Severity.WARNING, WHERE, what, remedy)
