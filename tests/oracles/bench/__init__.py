"""A second simulator of bench sessions, on NumPy, SciPy and h5py alone, that shares no code with the first.

It differs from `calib.bench` wherever physics leaves a choice: other elements and mesh, protrusions one by one in
place of a smooth change of conductivity, Boussinesq's stress in place of a Gaussian, a gas cell under a
stiffening wall in place of a curve, and faults that calibration meets on real benches (`Faults`).

    python -m tests.oracles.bench session.h5 --places 16 --crosstalk 0.05
"""

from . import contact, motion, pads
from .faults import Faults
from .file import write
from .session import Bench, Session, simulate

__all__ = ["Bench", "Faults", "Session", "contact", "motion", "pads", "simulate", "write"]
