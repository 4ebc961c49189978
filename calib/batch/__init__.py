"""Calibrate many sessions in parallel, by several processes or a cluster."""
