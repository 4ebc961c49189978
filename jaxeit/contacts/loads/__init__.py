"""What touches the skin in one frame: loads fitted through the pressure law."""

from .fitter import LoadFitter
from .preparation import prepare_loads
from .proposal import Proposal, Proposed, load_proposal, shipped_proposal
from .result import LoadKind, Loads, LoadShape
from .settings import LoadSettings

__all__ = [
    "LoadFitter",
    "LoadKind",
    "LoadSettings",
    "LoadShape",
    "Loads",
    "Proposal",
    "Proposed",
    "load_proposal",
    "prepare_loads",
    "shipped_proposal",
]
