"""Live force maps as frames arrive, for people (`page`, `rerun_view`) and for programs (lines of JSON).

A frame passes from the receiving threads (`record`) through `loop` and `engine` to a `FrameResult`, which `loop` hands
to every viewer.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
