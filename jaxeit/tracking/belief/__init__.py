"""The belief of contacts: what frames show of them, its change by one frame, and what stays unknown in all frames."""

from .layer import PRESS_VARIANCES

__all__ = ["PRESS_VARIANCES"]
