"""Material: a continuous metal coat, which conducts along the sheet."""

from typing import ClassVar

from jaxtyping import Array, Float

from .base import AbstractCoatEffect, parameter
from .material import power
from .quantities import Sheet


class ContinuousCoating(AbstractCoatEffect):
    """The metal is one sheet, not islands, and connects pressed places that are far apart.

    Sheet and metal, with potentials u and m, exchange current under pressure
    (`jaxeit.model.matrix.metal_sheet`):

        -div(sigma grad u) + g (u - m) = 0,  -div(grad m) / R_m + g (m - u) = 0,
        g = f / rho,  rho = rho_r (p / p_r)^-n.

    It replaces `ContactPiezoresistance` and `HomogenisedIslands`, which are local: list one of the
    three.  The metal touches no electrode.

    | meaning                                    | default | range      | unit    | source              |
    |--------------------------------------------|---------|------------|---------|---------------------|
    | resistance R_m of the metal per square     | 0.1     | 0.02 to 1  | ohm     | assumption          |
    | contact_resistivity rho_r at pressure p_r  | 16      | 1 to 1000  | ohm mm2 | assumption          |
    | reference_pressure p_r, over the area      | 64      |            | kPa     | 20 N on a 20 mm tip |
    | exponent n                                 | 1       | 0.6 to 1.2 | 1       | many spots          |
    | coverage f: share of the area that touches | 1/3     | 0 to 1     | 1       | that of the islands |

    Example:
        bridged = je.discretise(je.Scene(skin, (effects.ContinuousCoating(),)), je.Fidelity.draft())
        # a CoatedSheet, for je.forward
        two_sheets = je.conductivity(bridged, 1e4 * jnp.ones(len(bridged.areas)))
    """

    alternative: ClassVar[str] = "how pressure makes the sheet conduct"

    resistance: Float[Array, ""] = parameter(0.1, above=0.0)
    contact_resistivity: Float[Array, ""] = parameter(1.6e-5, above=0.0)
    reference_pressure: Float[Array, ""] = parameter(64e3, above=0.0)
    exponent: Float[Array, ""] = parameter(1.0)
    coverage: Float[Array, ""] = parameter(1 / 3, most=1.0)

    def __call__(self, sheet: Sheet) -> Sheet:
        coupling = (
            self.coverage / self.contact_resistivity * power(sheet.pressure / self.reference_pressure, self.exponent)
        )
        bearing = coupling if sheet.share is None else sheet.share * coupling
        return sheet._replace(metal=1 / self.resistance, coupling=bearing)
