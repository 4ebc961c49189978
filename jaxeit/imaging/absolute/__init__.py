"""What a frame itself tells, without a reference frame: conductivity, contacts, channels and electrodes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
