"""Names of `calib.live` and their modules, from which `__init__.py` imports them on first use."""

from . import bridges as bridges
from .engine import Engine as Engine, ReceivedFrame as ReceivedFrame
from .loop import LiveControl as LiveControl, LiveError as LiveError, LiveSettings as LiveSettings, run_live as run_live
from .results import (
    FrameResult as FrameResult,
    KindEstimate as KindEstimate,
    LogResult as LogResult,
    TouchEstimates as TouchEstimates,
)
from .views.presentation import Presentation as Presentation, present as present
