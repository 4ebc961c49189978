"""A calibration applied to frames: force maps in newtons, of a session and in space."""
