"""Errors on presses that a fit has not seen, and the choice among candidates by them."""
