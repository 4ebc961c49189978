"""Figures of reports: one module for each subject, and the parts that all figures share."""
