"""Units of files: converted to SI once, when a value is read or imported."""

from dataclasses import dataclass

SECOND = 1_000_000_000
"""ns; all time stamps are int64 nanoseconds."""

STANDARD_GRAVITY = 9.80665
"""m/s^2, exact by definition (3rd CGPM, 1901): a load of 1 g weighs 9.80665 mN."""


@dataclass(frozen=True)
class Unit:
    """Conversion to the SI unit named `si`: ``value_in_SI = factor * value + offset``."""

    si: str
    factor: float = 1.0
    offset: float = 0.0


UNITS = {
    "1": Unit("1"),
    "counts": Unit("1"),
    "V": Unit("V"),
    "mV": Unit("V", 1e-3),
    "uV": Unit("V", 1e-6),
    "A": Unit("A"),
    "mA": Unit("A", 1e-3),
    "uA": Unit("A", 1e-6),
    "Ohm": Unit("Ohm"),
    "S": Unit("S"),
    "Pa": Unit("Pa"),
    "hPa": Unit("Pa", 100.0),
    "kPa": Unit("Pa", 1e3),
    "MPa": Unit("Pa", 1e6),
    "mbar": Unit("Pa", 100.0),
    "bar": Unit("Pa", 1e5),
    "psi": Unit("Pa", 6894.757293168361),
    "N": Unit("N"),
    "mN": Unit("N", 1e-3),
    "kN": Unit("N", 1e3),
    "g": Unit("N", 1e-3 * STANDARD_GRAVITY),
    "kg": Unit("N", STANDARD_GRAVITY),
    "N m": Unit("N m"),
    "m": Unit("m"),
    "cm": Unit("m", 1e-2),
    "mm": Unit("m", 1e-3),
    "um": Unit("m", 1e-6),
    "m2": Unit("m2"),
    "s": Unit("s"),
    "ms": Unit("s", 1e-3),
    "us": Unit("s", 1e-6),
    "ns": Unit("s", 1e-9),
    "Hz": Unit("Hz"),
    "kHz": Unit("Hz", 1e3),
    "K": Unit("K"),
    "degC": Unit("K", 1.0, 273.15),
    "rad": Unit("rad"),
}
"""All accepted units by name; ``g`` and ``kg`` are loads (gram-force), as scales display them."""

VARIABLE_UNIT = {
    "voltage": "V",
    "pressure": "Pa",
    "force": "N",
    "position": "m",
    "temperature": "K",
    "counts": "1",
}
"""SI unit that a main variable of this name must have."""

STREAM_UNIT = {"eit": "V", "pressure": "Pa", "barometer": "Pa", "force": "N", "stage": "m", "temperature": "K"}
"""SI unit of what a stream of this name measures."""

RAW_UNITS = ("1", "V", "A", "Ohm", "S", "Hz")
"""SI units in which any sensor may be read, before it is converted to what it measures."""

KNOWN_UNITS = ", ".join(UNITS)


def wrong_quantity(stream: str, si: str) -> str:
    """What is wrong with a stream in this SI unit, such as a pressure in N; empty: nothing."""
    own = STREAM_UNIT.get(stream, si)
    if si in (own, *RAW_UNITS):
        return ""
    fitting = ", ".join(name for name, unit in UNITS.items() if unit.si == own)
    return f"{si} is no unit of what a stream of this name measures ({fitting}, or of a raw signal: V, counts)"
