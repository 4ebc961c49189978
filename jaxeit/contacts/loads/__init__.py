"""What touches the skin in one frame: loads fitted through the pressure law."""

from .fitter import LoadFitter
from .learning import learn_loads
from .preparation import prepare_loads
from .proposal import Proposal, Proposed, load_proposal, shipped_proposal
from .result import LoadKind, Loads, LoadShape
from .settings import ForceLaw, LoadSettings
from .sheet import AbstractGain

__all__ = [
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
    "shipped_proposal",
]
