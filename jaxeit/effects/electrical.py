"""Electrical: errors of electrodes, current source and amplifiers."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .base import MOST_STD, AbstractContactEffect, AbstractTerminalEffect, parameter
from .quantities import Circuit
from .random import own_normal


class ContactScatter(AbstractContactEffect):
    """Contact conductances vary from electrode to electrode, log-normally.

    ``g <- g exp(std n)``; perfect contacts remain perfect.

    | meaning                    | default | range  | unit | source     |
    |----------------------------|---------|--------|------|------------|
    | std of log conductance     | 0.5     | 0 to 1 | 1    | assumption |
    | seed of the electrodes     | 0       |        |      |            |
    """

    std: Float[Array, ""] = parameter(0.5, most=MOST_STD)
    seed: Int[Array, ""] = parameter(0)

    def __call__(self, contact: Float[Array, " electrodes"]) -> Float[Array, " electrodes"]:
        return contact * jnp.exp(self.std * own_normal(self, self.seed, contact.shape, contact.dtype))


class ElectrodeFault(AbstractTerminalEffect):
    """A lost electrode, with a source of finite compliance and amplifiers of finite input resistance.

    A resistance lies between the electrode and its wire.  The drive- wire is ground; each sense wire
    loads the sheet with an input resistance to ground; the source gives less than its nominal current where
    that current needs more than the compliance voltage.  The circuit of each reading is solved exactly; without
    the resistance and with infinite limits it is the ideal circuit.

    Electrodes lost together are one effect with arrays for ``electrode`` and ``resistance``: two
    effects would each take the other's electrode as intact.

    | meaning                                     | default | range       | unit | source               |
    |---------------------------------------------|---------|-------------|------|----------------------|
    | electrode, counted from 0                   | 0       |             |      |                      |
    | resistance in its wire                      | 1       | 0 to inf    | Mohm | assumption: a lost one |
    | compliance: largest voltage of the source   | 5       | 1 to inf    | V    | assumption           |
    | input_resistance of each amplifier input    | 10      | 1 to inf    | Mohm | assumption           |
    """

    electrode: Int[Array, " lost"] | Int[Array, ""] = parameter(0)
    resistance: Float[Array, " lost"] | Float[Array, ""] = parameter(1e6, finite=False)
    compliance: Float[Array, ""] = parameter(5.0, above=0.0, finite=False)
    input_resistance: Float[Array, ""] = parameter(1e7, above=0.0, finite=False)

    def __call__(self, voltage: Float[Array, " readings"], circuit: Circuit) -> Float[Array, " readings"]:
        lost = self.electrode
        wired = circuit._replace(z=circuit.z.at[lost, lost].add(self.resistance))
        source, _, plus, minus = circuit.pattern.T
        leak = 1 / self.input_resistance

        # Inputs draw leak * potential from plus and minus.  With D their difference and M the potential of
        # minus, per ampere:  D = d_a - leak (d_p (M + D) + d_m M),  M = m_a - leak (m_p (M + D) + m_m M).
        # Differences are used because the lost electrode's resistance exceeds the sheet's by many digits.
        d_a, d_p, d_m = (_difference(wired, into) for into in (source, plus, minus))
        m_a, m_p, m_m = (_potential(wired, minus, into) for into in (source, plus, minus))
        both, loaded = leak * (d_p + d_m), 1 + leak * (m_p + m_m)
        difference = (d_a * loaded - both * m_a) / ((1 + leak * d_p) * loaded - leak * both * m_p)
        at_minus = (m_a - leak * m_p * difference) / loaded

        a_a, a_p, a_m = (_potential(wired, source, into) for into in (source, plus, minus))
        path = a_a - leak * (a_p * (at_minus + difference) + a_m * at_minus)
        excess = jnp.maximum(1.0, circuit.current * path / self.compliance)
        return (voltage + circuit.current * (difference - _difference(circuit, source))) / excess


class CommonMode(AbstractTerminalEffect):
    """An amplifier passes part of the common-mode voltage: ``V <- V + gain (V+ + V-) / 2``.

    Potentials are above ground, to which the drive- electrode is tied, without the resistance of lost
    electrodes.  They include the contact resistance, which has no limit for
    fine meshes if an electrode is a point of the mesh.

    | meaning                           | default | range     | unit | source              |
    |-----------------------------------|---------|-----------|------|---------------------|
    | gain for what both share          | 1e-3    | 0 to 1e-2 | 1    | assumption: 60 dB   |
    """

    rank: ClassVar[int] = -1  # before `ElectrodeFault`, whose source scales this voltage too

    gain: Float[Array, ""] = parameter(1e-3, least=-jnp.inf)

    def __call__(self, voltage: Float[Array, " readings"], circuit: Circuit) -> Float[Array, " readings"]:
        source, _, plus, minus = circuit.pattern.T
        mean = (_potential(circuit, plus, source) + _potential(circuit, minus, source)) / 2
        return voltage + self.gain * circuit.current * mean


def _potential(
    circuit: Circuit, at: Int[Array, " readings"], into: Int[Array, " readings"]
) -> Float[Array, " readings"]:
    """Potential above drive-, per ampere into one electrode and out at drive-, in ohm."""
    z, sink = circuit.z, circuit.pattern[:, 1]
    return (z[at, into] - z[sink, into]) - (z[at, sink] - z[sink, sink])


def _difference(circuit: Circuit, into: Int[Array, " readings"]) -> Float[Array, " readings"]:
    """Voltage of sense+ above sense-, per ampere into one electrode and out at drive-, in ohm."""
    z, (_, sink, plus, minus) = circuit.z, circuit.pattern.T
    return (z[plus, into] - z[minus, into]) - (z[plus, sink] - z[minus, sink])
