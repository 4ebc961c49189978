"""A calibration as one HTML page, with its figures."""
