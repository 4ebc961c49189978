"""The disc with the complete electrode model, semi-analytically.

Unit disc, conductivity one, concentric inclusion of radius rho and conductivity s1.  The current
density j on each electrode is a sum of Legendre polynomials; the Neumann-to-Dirichlet map acts on
Fourier modes,

    (N j)(t) = sum_n q_n / (n pi) integral of cos n(t - p) j(p) dp,
    q_n = (1 + mu rho^2n) / (1 - mu rho^2n),    mu = (1 - s1) / (1 + s1),

and on electrode l   N j + c + z j = U_l,   integral of j = I_l,   with sum U = 0 and c the free
constant of the potential.  The n-th moment of the k-th Legendre polynomial on an electrode of
half-width w is ``2 w i^k j_k(n w)`` with the spherical Bessel function j_k, times the phase of the
electrode's centre.
"""

import numpy as np
from scipy.special import ive, spherical_jn


def disc_potentials(
    z: float,
    electrodes: int = 16,
    cover: float = 0.5,
    sigma1: float = 1.0,
    rho: float = 0.0,
    degree: int = 12,
    modes: int = 20000,
) -> np.ndarray:
    """Electrode potentials for +1 A in electrode 0 and -1 A in electrode 1, summing to zero."""
    width = cover * np.pi / electrodes
    rim = _neumann_to_dirichlet(electrodes, width, degree, modes, sigma1, rho)
    current = np.zeros(electrodes)
    current[:2] = 1, -1
    return potentials(rim, width, np.full(electrodes, z), current)


def even_disc(electrodes: int = 16, cover: float = 0.5, degree: int = 12, modes: int = 20000):
    """Potentials as a function of the contact impedance of each electrode and of currents (electrodes, drives)."""
    width = cover * np.pi / electrodes
    rim = _neumann_to_dirichlet(electrodes, width, degree, modes, 1.0, 0.0)
    return lambda z, currents: potentials(rim, width, z, currents)


def potentials(rim: np.ndarray, width: float, z: np.ndarray, currents: np.ndarray) -> np.ndarray:
    """Electrode potentials for these currents, (electrodes, ...), from the map of the rim."""
    electrodes, degree = len(z), len(rim) // len(z)
    net = np.kron(np.eye(electrodes), 2 * width * np.eye(degree, 1))  # only P_0 carries net current
    contact = np.diag(np.outer(z, 2 * width / (2 * np.arange(degree) + 1)).ravel())
    ones = np.ones((electrodes, 1))
    system = np.block(
        [
            [rim + contact, -net, net @ ones],
            [net.T, np.zeros((electrodes, electrodes + 1))],
            [np.zeros((1, len(net))), ones.T, np.zeros((1, 1))],
        ]
    )
    right = np.concatenate([np.zeros((len(net), *currents.shape[1:])), currents, np.zeros((1, *currents.shape[1:]))])
    # One equation too many: the currents sum to zero already.
    return np.linalg.lstsq(system, right, rcond=None)[0][len(net) : -1]


def _neumann_to_dirichlet(electrodes, width, degree, modes, sigma1, rho) -> np.ndarray:
    """Its Galerkin matrix over Legendre polynomials on all electrodes."""
    n, k = np.arange(1, modes + 1), np.arange(degree)
    damp = (1 - sigma1) / (1 + sigma1) * rho ** (2.0 * n)
    q = (1 + damp) / (1 - damp) / (n * np.pi)
    moments = (1j**k)[:, None] * 2 * width * np.array([spherical_jn(i, n * width) for i in k])
    phase = np.exp(2j * np.pi / electrodes * np.outer(np.arange(electrodes), n))
    modal = (phase[:, None, :] * moments).reshape(electrodes * degree, modes)
    return ((modal * q) @ modal.conj().T).real


def disc_resistance(radius: float, contact: float, sheet_resistance: float) -> float:
    """Resistance in ohm from a disc electrode into the sheet around it, in closed form.

    ``R_s L_T / (2 pi a) * I0(a / L_T) / I1(a / L_T)`` with the transfer length
    ``L_T = sqrt(contact / R_s)``: the modified Bessel solution of ``laplace(u) = (u - U) / L_T^2``
    under the disc.  Radius in m, contact in ohm m^2, sheet resistance in ohm per square.
    """
    transfer = np.sqrt(contact / sheet_resistance)
    ratio = radius / transfer
    return float(sheet_resistance * transfer / (2 * np.pi * radius) * ive(0, ratio) / ive(1, ratio))
