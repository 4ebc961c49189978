"""Classes of one kind by the names that files and the command line use."""

from .limits import AbstractChoice, SettingError, limited, require_limits
from .registry import Registry, RegistryError, split_word
from .settings import computed, settings_of

__all__ = [
    "AbstractChoice",
    "Registry",
    "RegistryError",
    "SettingError",
    "computed",
    "limited",
    "require_limits",
    "settings_of",
    "split_word",
]
