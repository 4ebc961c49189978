"""What touches the skin in one frame: loads fitted through the pressure law."""

from .fitter import LoadFitter
from .preparation import prepare_loads
from .result import LoadKind, Loads, LoadShape
from .settings import LoadSettings

__all__ = ["LoadFitter", "LoadKind", "LoadSettings", "LoadShape", "Loads", "prepare_loads"]
