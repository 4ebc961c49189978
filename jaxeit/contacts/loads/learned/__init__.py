"""What loads were learned from: presses of known force, and networks trained in simulation."""

from .proposal import (
    KINDS,
    LAYERS,
    PARAMETERS,
    SHAPES,
    WEIGHTS,
    Proposal,
    components,
    loads_by_kind,
    pad_inputs,
    standardised,
)

__all__ = [
    "KINDS",
    "LAYERS",
    "PARAMETERS",
    "SHAPES",
    "WEIGHTS",
    "Proposal",
    "components",
    "loads_by_kind",
    "pad_inputs",
    "standardised",
]
