"""Accuracy against time: settings to compare, the study, and its recommendation."""

from .recommendation import Ladder, Rung
from .settings import (
    Choice,
    LadderError,
    Touch,
    few_choices,
    fidelity_choices,
    image_choices,
)
from .study import ladder

__all__ = [
    "Choice",
    "Ladder",
    "LadderError",
    "Rung",
    "Touch",
    "few_choices",
    "fidelity_choices",
    "image_choices",
    "ladder",
]
