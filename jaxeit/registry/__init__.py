"""Classes of one kind by the names that files and the command line use."""

from .registry import Registry, RegistryError, split_word
from .settings import computed, settings_of

__all__ = ["Registry", "RegistryError", "computed", "settings_of", "split_word"]
