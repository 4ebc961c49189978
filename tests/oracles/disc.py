"""The disc with the complete electrode model, semi-analytically.

Unit disc, conductivity one, concentric inclusion of radius rho and conductivity s1.  The current
density j on each electrode is expanded in Legendre polynomials; the Neumann-to-Dirichlet map acts
on Fourier modes, ``(N j)(t) = sum_n q_n / (n pi) integral of cos n(t - p) j(p)``, with
``q_n = (1 + mu rho^2n) / (1 - mu rho^2n)``, ``mu = (1 - s1) / (1 + s1)``, and on each electrode
``N j + z j = U_l``, ``integral of j = I_l``.  The modes of a Legendre polynomial on an electrode of
half-width w are ``2 w i^k j_k(n w)`` (spherical Bessel).
"""

import numpy as np
from scipy.special import eval_legendre, roots_legendre, spherical_jn


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
    centres = 2 * np.pi * np.arange(electrodes) / electrodes
    n, k = np.arange(1, modes + 1), np.arange(degree)
    mu = (1 - sigma1) / (1 + sigma1)
    damp = mu * rho ** (2.0 * n)
    q = (1 + damp) / (1 - damp) / (n * np.pi)
    bessel = np.array([spherical_jn(i, n * width) for i in k])
    moments = 2 * width * bessel  # times i^k and the phase of the centre
    phase = np.exp(1j * np.outer(centres, n))
    table = (1j**k)[:, None] * moments
    modal = (phase[:, None, :] * table).reshape(electrodes * degree, modes)
    galerkin = (modal * q) @ modal.conj().T
    galerkin = galerkin.real
    mass = np.tile(2 * width / (2 * k + 1), electrodes)
    system = galerkin + z * np.diag(mass)
    net = np.zeros((electrodes * degree, electrodes))
    net[np.arange(electrodes) * degree, np.arange(electrodes)] = 2 * width
    current = np.zeros(electrodes)
    current[:2] = 1, -1
    ones = np.ones((electrodes, 1))
    block = np.block(
        [
            [system, -net, np.zeros((electrodes * degree, 1))],
            [net.T, np.zeros((electrodes, electrodes)), 0 * ones],
            [np.zeros((1, electrodes * degree)), ones.T, np.zeros((1, 1))],
        ]
    )
    # j = sum c P_k; the potential of the disc is fixed up to a constant, which U sum = 0 sets: the
    # mean of N j is zero, so a free constant joins the electrode equations.
    constant = np.concatenate([-net.sum(1), np.zeros(electrodes), [0]])
    block[:, -1] = constant
    solution = np.linalg.lstsq(block, np.concatenate([np.zeros(electrodes * degree), current, [0]]), rcond=None)[0]
    return solution[electrodes * degree : -1]


__all__ = ["disc_potentials", "eval_legendre", "roots_legendre"]
