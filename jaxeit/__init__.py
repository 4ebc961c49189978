"""jaxeit: from what an EIT-pneumatic robot skin records to force maps in newtons.

Nouns are frozen pytrees, verbs are pure jitted functions, choices are objects, and physics that is
not in the scene is not in the program.

The names used every day are here; each room holds the rest, such as `jaxeit.effects.Creep` or
`jaxeit.metrics.greit_figures`.
"""

from importlib import metadata

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = metadata.version("jaxeit")
