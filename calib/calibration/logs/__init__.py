"""Logs of force and a signal, without EIT: calibrated, evaluated, recalibrated, saved and mapped to forces."""
