"""Loads of one frame, fitted through the pressure law and the full forward map: none, one, two, an edge, or three.

Contacts in load space are pressures (place, force, width, length), not bumps of conductivity. They add before the law
that turns pressure into conductivity, which saturates; bumps that add leave misfits of 7 to 9 on two contacts where the
noise is 1. With p the pressure of all loads and f the law, the readings are those of the conductivity sigma f(p g).

What is not known besides the loads is what errs: the gain g = exp(std field) of the contact layer, which moves a load,
bends it and splits it; the coat of the sheet; and the shape of a load. All of it is marginalised to first order. With N
the slopes of the r whitened readings y in these unknowns, each of standard deviation one, and e the part of the signal
by which all else errs, errors have the covariance (1 + e^2 |y|^2 / r) I + N N'. Kinds are compared by their evidence in
Laplace's approximation (MacKay 1992, Neural Comput. 4), so that probabilities and covariances hold the model's error as
well as the noise. The covariance that is handed out also holds that shapes may be larger or smaller, as the frame
tells, and that slopes are those of the fit's end (`considered`); a single load moves by half of its mean error.

The host decides what is fitted next; JAX runs two compiled programs, which serve all kinds (`pressure`).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..._compile import require_known
from ...imaging.inputs import InverseError, require_real
from ...imaging.readings.whitening import Whitening
from ..result import Contacts
from .belief import LoadBelief
from .fits.kinds import FrameFits
from .fits.programs import whiten_frame
from .result import Loads, Proposed
from .search import FrameSearch
from .starts import Starts


class LoadFitter(eqx.Module):
    """Fits loads to frames; made by `prepare_loads`, called with a frame and the contacts that a finder saw in it.

    | meaning                                                             | shape  |
    |---------------------------------------------------------------------|--------|
    | belief: of loads and of the sheet before a frame                    |        |
    | whitening, compress: from readings to whitened ones                 | , (r, k) |
    | starts: where fits begin                                            |        |

    Example:
        settings = je.contacts.LoadSettings(force=5.0)  # N, usual here
        fitter = je.contacts.prepare_loads(model, settings, noise=noise, sigma=model.background)
        loads = fitter(dv, found)
        print(loads.kind.name, loads.probability)
        print(loads.of(je.contacts.LoadKind.TWO).force)  # N, as the law of pressure in the settings has it
    """

    belief: LoadBelief
    whitening: Whitening
    compress: Float[Array, "r k"]
    starts: Starts

    def __call__(self, dv: Float[ArrayLike, " readings"], contacts: Contacts) -> Loads:
        """Loads of one difference frame (readings,) V, from the contacts that a `ContactFinder` saw in it.

        Raises:
            InverseError: if the frame has another shape, or a reading that is used is not finite.
        """
        require_known("LoadFitter", InverseError, dv, contacts)
        return self._search(dv, contacts.present.ndim - 1, contacts).loads()

    def refine(self, dv: Float[ArrayLike, " readings"], proposed: Proposed, contacts: Contacts | None = None) -> Loads:
        """Loads of one difference frame (readings,) V, from those that a `Proposal` proposes.

        Kinds of a probability below `MIN_PROBABILITY` are not fitted, and the others once each. Probabilities are those
        of the proposal times those of the fits (`EVIDENCE_WEIGHT`). Where the misfit of the most probable kind is above
        `MAX_REDUCED_MISFIT`, all kinds are searched too, and the more probable fit of each counts. A frame that lies
        outside of what the proposal was trained on is fitted as without it.

        Args:
            contacts: that a `ContactFinder` saw in the frame, where a search begins; None: from all over the sheet.

        Raises:
            InverseError: as when called.
        """
        require_known("LoadFitter", InverseError, dv, proposed, contacts)
        batch = max(np.ndim(proposed.distance), 0 if contacts is None else contacts.present.ndim - 1)
        search = self._search(dv, batch, contacts)
        return search.refine(proposed) if not proposed.outside else search.loads()

    def whitened(self, dv: Float[ArrayLike, " readings"], batch: int) -> np.ndarray:
        """The whitened readings of one frame."""
        require_real(dv=dv)
        dv, used = np.asarray(dv, float), np.asarray(self.whitening.channels)
        if dv.shape != used.shape or batch:
            raise InverseError(f"dv has shape {dv.shape}; fit one frame of {len(used)} readings at a time")
        if not np.isfinite(dv[used]).all():
            first = int(np.argmax(used & ~np.isfinite(dv)))
            raise InverseError(f"reading {first} is not finite; leave its channel out")
        return np.asarray(whiten_frame(self.whitening, self.compress, jnp.asarray(dv, self.compress.dtype)))

    def _search(self, dv: Float[ArrayLike, " readings"], batch: int, contacts: Contacts | None) -> FrameSearch:
        return FrameSearch(FrameFits(self.belief, self.whitened(dv, batch)), self.starts, contacts)
