"""Recipes of calibrations, as objects and as TOML."""
