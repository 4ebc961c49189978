"""Recalibration: a calibration moved to what the pads read now, from known forces or from ordinary use."""
