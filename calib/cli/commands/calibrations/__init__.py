"""Commands that make a calibration, or put one to use."""
