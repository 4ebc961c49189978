"""Checks of single streams: their samples and clocks, and columns that have changed places."""
