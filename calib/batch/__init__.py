"""Calibrate many sessions, or simulate frames for training, by several processes or a cluster."""
