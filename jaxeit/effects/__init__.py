"""Effects: departures from the ideal sensor, one small class each, listed in a scene one by one.

An effect that a scene does not list is neither computed nor compiled.  To add one: a class in the
file of its family, a line here, a row in tests/test_effects.py.
"""

from ._base import (
    AbstractEffect,
    AbstractLoadEffect,
    AbstractPadEffect,
    AbstractReadoutEffect,
    AbstractSheetEffect,
    Sheet,
    Stream,
    Touch,
    fold,
)
from .material import CoatingNonUniformity, ContactGain, ContactPiezoresistance
from .mechanics import LoadSpreading
from .pneumatics import PadEdgeDip
from .readout import BaselineDrift, Noise, Quantisation

EFFECTS: dict[str, type[AbstractEffect]] = {
    effect.__name__: effect
    for effect in (
        LoadSpreading,
        CoatingNonUniformity,
        ContactGain,
        ContactPiezoresistance,
        PadEdgeDip,
        BaselineDrift,
        Noise,
        Quantisation,
    )
}

__all__ = [
    "EFFECTS",
    "AbstractEffect",
    "AbstractLoadEffect",
    "AbstractPadEffect",
    "AbstractReadoutEffect",
    "AbstractSheetEffect",
    "BaselineDrift",
    "CoatingNonUniformity",
    "ContactGain",
    "ContactPiezoresistance",
    "LoadSpreading",
    "Noise",
    "PadEdgeDip",
    "Quantisation",
    "Sheet",
    "Stream",
    "Touch",
    "fold",
]
