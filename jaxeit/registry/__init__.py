"""Classes of one kind by the names that files and the command line use.

Example:
    import jax

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    print(list(je.imaging.PRIORS))  # the names that files and the command line use
    prior = je.imaging.PRIORS.make("gaussian-smooth:length=0.02,noser=true")
    print(je.imaging.PRIORS.text(prior), je.imaging.PRIORS.settings(prior))  # a word, or a table
    print(je.registry.settings_of(je.GaussianSmooth, ()).keys())
    try:
        je.imaging.PRIORS.make("gausian-smooth")
    except je.registry.RegistryError as error:
        print(error)
"""

from .limits import AbstractChoice, SettingError, limited, require_limits
from .registry import Registry, RegistryError, from_words, split_word
from .settings import computed, settings_of

__all__ = [
    "AbstractChoice",
    "Registry",
    "RegistryError",
    "SettingError",
    "computed",
    "from_words",
    "limited",
    "require_limits",
    "settings_of",
    "split_word",
]
