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
from ...imaging.noise import InverseError, Whitening, require_real
from ..result import Contacts
from .comparison import FORMS, Comparison, free_parameters
from .programs import white
from .proposal import Proposed
from .result import LoadKind, Loads
from .sheet import PressedSheet
from .starts import Starts


class LoadFitter(eqx.Module):
    """Fits loads to frames; made by `prepare_loads`, called with a frame and the contacts that a finder saw in it.

    | meaning                                                             | shape            | unit |
    |---------------------------------------------------------------------|------------------|------|
    | sheet: from loads to whitened readings                              |                  |      |
    | whitening, compress: from readings to whitened ones                 | , (r, k)         |      |
    | starts: where fits begin                                            |                  |      |
    | low, high: corners of the sheet                                     | (2,)             | m    |
    | usual, spread: mean and standard deviation of log width, log force  | (2,)             |      |
    | difference: standard deviation of their differences between loads   | (2,)             |      |
    | least: distance of two loads, length of an edge, that is not one load | (2,)           | m    |
    | length, prior, model_error, shapes: see `LoadSettings`              | (), (5,), (), (factors,) | |
    | force_logs, force_covariance, force_variance: see `ForceLaw`        | (3,), (3, 3), () |      |

    Example:
        settings = je.contacts.LoadSettings(force=5.0)  # N, usual here
        fitter = je.contacts.prepare_loads(model, settings, noise=noise, sigma=model.background)
        loads = fitter(dv, found)
        print(loads.kind.name, loads.probability)
        print(loads.of(je.contacts.LoadKind.TWO).force)  # N, as the law of pressure in the settings has it
    """

    sheet: PressedSheet
    whitening: Whitening
    compress: Float[Array, "r k"]
    starts: Starts
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    usual: Float[Array, "2"]
    spread: Float[Array, "2"]
    difference: Float[Array, "2"]
    least: Float[Array, "2"]
    length: Float[Array, ""]
    prior: Float[Array, "5"]
    model_error: Float[Array, ""]
    shapes: Float[Array, " factors"]
    force_logs: Float[Array, "3"]
    force_covariance: Float[Array, "3 3"]
    force_variance: Float[Array, ""]

    def __call__(self, dv: Float[ArrayLike, " readings"], contacts: Contacts) -> Loads:
        """Loads of one difference frame (readings,) V, from the contacts that a `ContactFinder` saw in it.

        Raises:
            InverseError: if the frame has another shape, or a reading that is used is not finite.
        """
        require_known("LoadFitter", InverseError, dv, contacts)
        return Comparison(self, self.whitened(dv, contacts.present.ndim - 1), contacts).loads()

    def refine(self, dv: Float[ArrayLike, " readings"], proposed: Proposed, contacts: Contacts | None = None) -> Loads:
        """Loads of one difference frame (readings,) V, from those that a `Proposal` proposes.

        Kinds of a probability below `MIN_PROBABILITY` are not fitted, and the others once each. Probabilities are those
        of the proposal times what the fits say (`TRUST`). Where the most probable kind leaves more than is believed
        (`SURPRISING`), all kinds are searched too, and the more probable fit of each counts. A frame that lies outside
        of what the proposal was trained on is told as without it.

        Args:
            contacts: that a `ContactFinder` saw in the frame, where a search begins; None: from all over the sheet.

        Raises:
            InverseError: as when called.
        """
        require_known("LoadFitter", InverseError, dv, proposed, contacts)
        batch = max(np.ndim(proposed.distance), 0 if contacts is None else contacts.present.ndim - 1)
        search = Comparison(self, self.whitened(dv, batch), contacts)
        return search.refined(proposed) if not proposed.outside else search.loads()

    def whitened(self, dv: Float[ArrayLike, " readings"], batch: int) -> np.ndarray:
        """The whitened readings of one frame."""
        require_real(dv=dv)
        dv, used = np.asarray(dv, float), np.asarray(self.whitening.channels)
        if dv.shape != used.shape or batch:
            raise InverseError(f"dv has shape {dv.shape}; fit one frame of {len(used)} readings at a time")
        if not np.isfinite(dv[used]).all():
            first = int(np.argmax(used & ~np.isfinite(dv)))
            raise InverseError(f"reading {first} is not finite; leave its channel out")
        return np.asarray(white(self, jnp.asarray(dv, self.low.dtype)))

    @property
    def scale(self) -> np.ndarray:
        """Rows (2, 6) of mean and standard deviation of what is known of a load before a frame; infinite: nothing."""
        usual, spread, length = np.asarray(self.usual), np.asarray(self.spread), float(self.length)
        return np.array([[0, 0, *usual, 0, 0], [np.inf, np.inf, *spread, length, length]])

    def bounds(self, start: np.ndarray, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest parameters: on the sheet, and within four deviations of what is usual.

        What a row does not have stays where it starts.
        """
        mean, deviation = self.scale
        deviation = np.where(np.isfinite(deviation), deviation, 0)
        low, high = mean - 4 * deviation, mean + 4 * deviation
        low[:2], high[:2] = self.low, self.high
        free = free_parameters(forms)
        return np.where(free, low, start), np.where(free, high, start)

    def log_prior(self, kind: LoadKind, loads: np.ndarray) -> float:
        """Logarithm of the density of parameters before the frame, less that of the squares of surprise."""
        more, deviation = len(FORMS[kind]) - 1, self.scale[1]
        area = float(np.prod(np.asarray(self.high - self.low)))
        found = -np.log(area) - np.sum(np.log(deviation[2:4])) - np.log(2 * np.pi)
        if kind is LoadKind.EDGE:  # either end of an edge may be the first
            return float(found + np.log(2.0) - 2 * np.log(deviation[4]) - np.log(2 * np.pi))
        half = 0.5 * (loads[1 : more + 1, :2] - loads[0, :2]) / deviation[4]
        near = np.exp(-0.5 * np.sum(half**2, 1)) / (2 * np.pi * (2 * deviation[4]) ** 2)
        found += np.sum(np.log(0.5 * near + 0.5 / area))
        found -= more * (np.sum(np.log(np.asarray(self.difference))) + np.log(2 * np.pi))
        return float(found + np.sum(np.log(np.arange(1, more + 2))))  # loads in any order
