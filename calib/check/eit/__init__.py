"""Checks of EIT readings: dead, saturated, noisy or not reciprocal ones, and the order of the readings."""
