"""Files of calibrations: written, checked and read back."""
