"""Fits of kinds of loads to one frame, and how they compare."""
