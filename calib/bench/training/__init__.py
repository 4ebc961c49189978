"""Frames for training: random scenes, and folders of their frames."""
