"""Live force maps as frames arrive, for people (`page`, `rerun_view`) and for programs (lines of JSON).

A frame passes from the receiving threads (`record`) through `loop` and `engine` to a `FrameResult`, which `loop` hands
to every viewer.
"""

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .engine import Engine
    from .loop import LiveControl, LiveError, LiveSettings, run_live
    from .presentation import Presentation, present
    from .results import FrameResult, TouchEstimates

__getattr__, __all__ = lazy_names(
    __name__,
    {
        "engine": "Engine",
        "loop": "LiveControl LiveError LiveSettings run_live",
        "presentation": "Presentation present",
        "results": "FrameResult TouchEstimates",
    },
)
