"""What touches the skin in one frame: loads fitted through the pressure law."""

from .fitter import LoadFitter
from .learned.learning import learn_loads
from .learned.proposal import Proposal, load_proposal, shipped_proposal
from .preparation import prepare_loads
from .pressure import MAX_LOADS
from .result import LoadKind, Loads, LoadShape, Proposed
from .settings import ForceLaw, LoadSettings
from .sheet import AbstractGain, scaled_law

__all__ = [
    "MAX_LOADS",
    "AbstractGain",
    "ForceLaw",
    "LoadFitter",
    "LoadKind",
    "LoadSettings",
    "LoadShape",
    "Loads",
    "Proposal",
    "Proposed",
    "learn_loads",
    "load_proposal",
    "prepare_loads",
    "scaled_law",
    "shipped_proposal",
]
