"""Compare a frame of the untouched skin with the model of the skin, as `check_session` does for a recording."""

import numpy as np
from jaxtyping import Bool, Float

import jaxeit as je

from ..report import Finding, Severity
from .model import SkinModel, are_enough
from .order_findings import AMPLITUDE_RATIO_OF_OTHER_ORDERS, WHERE, amplitude_findings, order_findings
from .reading_order import transfer_matrix


class UntouchedCheck:
    """Compares frames with the uniform sheet of a skin: order, signs and amplitude of the readings.

    The model is solved once, which compiles programs. A frame that resembles it costs a product; for one that does not,
    many orders are tried, some tenths of a second.

    Raises:
        ValueError: if the skin cannot be meshed.
    """

    def __init__(self, skin: je.Skin):
        self._scan, self._model = skin.protocol, SkinModel.of(skin, transfer_matrix(skin))

    def __call__(
        self, untouched: Float[np.ndarray, " readings"], used: Bool[np.ndarray, " readings"]
    ) -> tuple[Finding, ...]:
        """What is wrong with a mean frame without contact, V; nothing where too few readings are used and finite."""
        good = used & np.isfinite(untouched)
        if not are_enough(good):
            return ()
        sizes = [float(np.sqrt(np.mean(part[good] ** 2))) for part in (untouched, self._model.predict(self._scan))]
        if sizes[0] < AMPLITUDE_RATIO_OF_OTHER_ORDERS[0] * sizes[1]:
            return (_about_zero(*sizes),)
        order = self._model.check(untouched, good, self._scan)
        return (*order_findings(order), *amplitude_findings(order))


def _about_zero(measured: float, expected: float) -> Finding:
    """Readings much smaller than those of the model; root mean squares in V."""
    what = (
        f"the readings of the untouched skin are about zero: {1e3 * measured:.2g} mV (root mean square), where the "
        f"model expects {1e3 * expected:.2g} mV. Order and signs were not checked"
    )
    remedy = "send the voltages themselves without a reference frame subtracted, in V; check the drive current"
    return Finding(Severity.WARNING, WHERE, what, remedy)
