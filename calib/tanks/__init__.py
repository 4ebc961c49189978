"""Tanks of others: files of EIDORS, the Kuopio challenge, PyEIDORS, instruments and NumPy; images of their frames."""

from .formats import load_eidors, load_instrument, load_ktc, load_npz, load_pyeidors, load_sciospec, load_tank
from .images import TankImage, difference_image, segmented_frame
from .recording import Tank, TankError

__all__ = [
    "Tank",
    "TankError",
    "TankImage",
    "difference_image",
    "load_eidors",
    "load_instrument",
    "load_ktc",
    "load_npz",
    "load_pyeidors",
    "load_sciospec",
    "load_tank",
    "segmented_frame",
]
