"""Information of each four-terminal reading on the place of a contact, for contacts all over the sheet.

A contact changes the conductivity of the sheet by ``sigma_0 a g(r - p; s)``, g a Gaussian bump of height one. Its place
p is wanted; its strength a and width s are nuisances. By linearity and reciprocity each reading is a difference of four
entries of the transfer matrix Z (`jaxeit.model.forward_model`), so that the sensitivities of *all* readings to a
contact follow from one matrix of electrodes x electrodes for each unknown: the solver sees one drive per electrode.

    M = prior + sum_i j_i j_i^T,       covariance of place = the 2 x 2 block of M^-1,

with j_i the derivatives of reading i in units of its noise (Cramer-Rao, nuisances marginalised).
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Integer

from .._compile import require_known, verb
from ..budget import require
from ..contacts.bump_responses import quadrature_rule
from ..linalg import lapack
from ..model.bases import Pixels
from ..model.discretisation import Model
from ..model.forward_model import fields, four_terminal, series_slopes, terminal_matrix, transfer
from ..model.sheet_conductivity import coefficients
from ..skin.protocol import ProtocolError

RealArray = np.ndarray | Array
UNKNOWNS = 4
"""Unknowns of a contact: place x and y in units of its width, log strength, log width."""
NOISE_DB = 60.0
"""Default noise of a reading, below the rms of the readings of the skin's own scan."""


@dataclass(frozen=True)
class DesignSettings:
    """The contacts and the noise for which a scan is designed.

    | meaning                                                                        | default       | unit |
    |--------------------------------------------------------------------------------|---------------|------|
    | width: standard deviation of a contact                                         | 0.012         | m    |
    | strength: relative change of conductivity at its centre                        | 0.25          |      |
    | columns: sites along x, from rim to rim                                        | 8             |      |
    | noise: standard deviation of each reading; None: 60 dB below the rms of the scan | None        | V    |
    | relative: further noise of each reading, as part of its voltage                | 0             |      |
    | model_error: as of `ContactSettings`: part of the signal that a fit gets wrong  | 0.015         |      |
    | strength_spread: standard deviation of log strength                            | 1             |      |
    | width_spread: standard deviation of log width                                  | 0.3           |      |

    Raises:
        ProtocolError: for a value out of range.
    """

    width: float = 0.012
    strength: float = 0.25
    columns: int = 8
    noise: float | None = None
    relative: float = 0.0
    model_error: float = 0.015
    strength_spread: float = 1.0
    width_spread: float = 0.3

    def __post_init__(self) -> None:
        positive = ("width", "strength", "strength_spread", "width_spread", *(("noise",) if self.noise else ()))
        for name in positive:
            if not 0 < getattr(self, name) < np.inf:
                raise ProtocolError(f"{name} is {getattr(self, name)}; give a number above 0")
        if self.noise == 0:
            raise ProtocolError("noise is 0 V; give a standard deviation above 0, or None")
        for name in ("relative", "model_error"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ProtocolError(f"{name} is {getattr(self, name)}; give 0 or more")
        if not 1 <= self.columns <= 100:
            raise ProtocolError(f"columns is {self.columns}; give 1 to 100 sites along x")


class PlaceSensitivity(eqx.Module):
    """Sensitivity of any reading to a contact at each of many sites; made by `place_sensitivity`.

    | meaning                                                             | shape                           | unit |
    |---------------------------------------------------------------------|---------------------------------|------|
    | slopes: of the transfer matrix, times the current, for each unknown | (sites, 4, electrodes, electrodes) | V |
    | transfer matrix of the untouched sheet, times the current           | (electrodes, electrodes)        | V    |
    | sites                                                               | (sites, 2)                      | m    |
    | width: unit of the unknown place                                    | ()                              | m    |
    | noise, relative, model_error: see `DesignSettings`                  | ()                              | V, 1 |
    | prior: precision of each unknown before a frame                     | (4,)                            |      |
    """

    slopes: Float[Array, "sites 4 electrodes electrodes"]
    transfer: Float[Array, "electrodes electrodes"]
    sites: Float[Array, "sites 2"]
    width: Float[Array, ""]
    noise: Float[Array, ""]
    relative: Float[Array, ""]
    model_error: Float[Array, ""]
    prior: Float[Array, "4"]

    @property
    def electrodes(self) -> int:
        """Number of electrodes."""
        return self.transfer.shape[0]

    @verb
    def voltages(self, pattern: Integer[ArrayLike, "readings 4"]) -> Float[Array, " readings"]:
        """Readings of the untouched sheet, (readings,) V."""
        found: Array = four_terminal(self.transfer, jnp.asarray(pattern))
        return found

    @verb
    def rows(self, pattern: Integer[ArrayLike, "readings 4"]) -> Float[Array, "sites 4 readings"]:
        """Derivatives of readings with respect to the unknowns of a contact, in units of the error of each reading."""
        std = jnp.sqrt(self.noise**2 + (self.relative * self.voltages(pattern)) ** 2)
        found: Array = four_terminal(self.slopes, jnp.asarray(pattern)) / std
        change = found[:, 2:3]  # derivative with respect to log strength: the signal of the contact itself
        found = found / jnp.sqrt(1 + (self.model_error * change) ** 2)
        return found

    def covariance(self, rows: Float[Array, "sites 4 readings"]) -> Float[Array, "sites 4 4"]:
        """Covariance of the unknowns at each site after the readings of these `rows`."""
        return inverse_information(jnp.einsum("sai,sbi->sab", rows, rows) + jnp.diag(self.prior))

    def errors(
        self, pattern: Integer[ArrayLike, "readings 4"], dead: Integer[ArrayLike, ""] | None = None
    ) -> Float[Array, " sites"]:
        """Expected error of the place of a contact at each site, (sites,) m: root of the sum of both variances.

        Args:
            pattern: the readings of a frame.
            dead: number of an electrode whose readings are left out.
        """
        return _errors(self, jnp.asarray(pattern), jnp.asarray(-1 if dead is None else dead))

    def worst_dead(self, pattern: Integer[ArrayLike, "readings 4"]) -> tuple[int, float]:
        """The electrode whose death costs most, and the rms over sites of `errors` without it, m."""
        require_known("worst_dead", ProtocolError, pattern, self)
        used = np.unique(np.asarray(pattern))
        rms = [_rms(self.errors(pattern, dead)) for dead in used]
        return int(used[np.argmax(rms)]), max(rms)


@verb
def _errors(
    sensitivity: PlaceSensitivity, pattern: Integer[Array, "readings 4"], dead: Integer[Array, ""]
) -> Float[Array, " sites"]:
    covariance = sensitivity.covariance(jnp.where(jnp.all(pattern != dead, 1), sensitivity.rows(pattern), 0))
    return sensitivity.width * jnp.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])


def _rms(values: RealArray) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def inverse_information(information: Float[Array, "s 4 4"]) -> Float[Array, "s 4 4"]:
    """Covariance of all unknowns at each site."""

    def inverse(m: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
        return lapack.cho_solve(lapack.cho_factor(m, lower=True), jnp.eye(UNKNOWNS, dtype=m.dtype))

    found: Array = jax.vmap(inverse)(information)
    return found


def place_sensitivity(model: Model, settings: DesignSettings | None = None) -> PlaceSensitivity:
    """Sensitivity of every reading that the electrodes of a model can take, to contacts all over the sheet.

    The current source and the amplifiers are ideal, and the sheet is the untouched one of the model. On a surface, the
    contact is round in the flat sheet.

    Args:
        model: of a scene with the skin; its protocol sets the current and the default noise only.
        settings: default `DesignSettings`.

    Raises:
        BudgetError: if the sensitivities need too much memory; a coarser fidelity needs less.
    """
    require_known("place_sensitivity", ProtocolError, model)
    settings = settings or DesignSettings()
    return SiteContacts.of(model, settings, sheet_sites(model, settings.columns)).sensitivity(model, model.chart)


def sheet_sites(model: Model, columns: int) -> Float[np.ndarray, "sites 2"]:
    """Centres of the pixels of which more than half lies on the sheet, m."""
    pixels = Pixels(columns).on(model)
    areas = np.asarray(pixels.areas)
    found: np.ndarray = np.asarray(pixels.centres, float)[areas > 0.5 * areas.max()]
    return found


class SiteContacts(eqx.Module):
    """Contacts at sites of the sheet, and what is known of them and of the noise.

    | meaning                                                             | shape      | unit |
    |---------------------------------------------------------------------|------------|------|
    | sites                                                               | (sites, 2) | m    |
    | rule, weights: points of an element, and their weights              | (q, 3), (q,) | 1  |
    | width, strength, relative, model_error: see `DesignSettings`        | ()         | m, 1 |
    | noise: standard deviation of each reading                           | ()         | V    |
    | prior: precision of each unknown before a frame                     | (4,)       |      |
    """

    sites: Float[Array, "sites 2"]
    rule: Float[Array, "q 3"]
    weights: Float[Array, " q"]
    width: Float[Array, ""]
    strength: Float[Array, ""]
    noise: Float[Array, ""]
    relative: Float[Array, ""]
    model_error: Float[Array, ""]
    prior: Float[Array, "4"]

    @staticmethod
    def of(model: Model, settings: DesignSettings, sites: Float[np.ndarray, "sites 2"]) -> "SiteContacts":
        """Contacts at these sites, for a model of this skin; raises BudgetError if the slopes need too much memory."""
        pairs = model.electrodes**2
        size = 8 * (len(sites) * UNKNOWNS * max(pairs, len(model.areas)) + pairs * len(model.areas))
        require("array_bytes", size, "place_sensitivity: sites times elements or pairs of electrodes")
        z = float(model.current) * np.asarray(transfer(model, coefficients(model, None)), float)
        noise = settings.noise or 10 ** (-NOISE_DB / 20) * _rms(four_terminal(z, np.asarray(model.pattern)))
        extent = float(np.linalg.norm(np.ptp(np.asarray(model.chart), axis=0))) / settings.width  # it is on the sheet
        prior = np.array([extent, extent, settings.strength_spread, settings.width_spread]) ** -2
        errors = (noise, settings.relative, settings.model_error)
        arrays = (sites, *quadrature_rule(model, settings.width), settings.width, settings.strength, *errors, prior)
        return SiteContacts(*(jnp.asarray(array, model.dtype) for array in arrays))

    @verb
    def sensitivity(self, model: Model, chart: Float[Array, "nodes 2"]) -> PlaceSensitivity:
        """Sensitivity of every reading to the contacts; ``chart``: flat coordinates of the nodes, m, which may move."""
        theta = coefficients(model, None)
        x = fields(model, theta)
        gradients = model.system.gradients(x.potential)
        products = jnp.einsum("era,erb->eab", gradients, gradients)
        resistances = series_slopes(model.system, theta)
        corners = chart[model.triangles]
        diagonal = np.arange(model.electrodes)

        def slopes(site: Float[Array, "2"]) -> Float[Array, "4 electrodes electrodes"]:
            change = model.background * self._bump(corners, site)
            found = -jnp.einsum("ke,eab->kab", change, products)
            return found.at[:, diagonal, diagonal].add(change @ resistances.T)

        found = self.strength * model.current * jax.lax.map(slopes, self.sites)
        z = model.current * terminal_matrix(model, theta, x)
        return PlaceSensitivity(
            found, z, self.sites, self.width, self.noise, self.relative, self.model_error, self.prior
        )

    def _bump(self, corners: Float[Array, "elements 3 2"], site: Float[Array, "2"]) -> Float[Array, "4 elements"]:
        """Mean over each element of a bump's derivatives with respect to the unknowns."""
        x, y = jnp.moveaxis((jnp.einsum("qk,ekd->eqd", self.rule, corners) - site) / self.width, -1, 0)
        square = x**2 + y**2
        derivatives = jnp.exp(-0.5 * square) * jnp.stack([x, y, jnp.ones_like(x), square])
        means: Array = derivatives @ self.weights
        return means
