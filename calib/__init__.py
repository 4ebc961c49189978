"""calib: from what a bench or a robot recorded to newtons.

The names used every day are here; each room holds the rest, such as `calib.fitting.Huber`.
Rooms and names are imported on first use, so that the command line answers at once.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
