"""Capture planning: sweeps that cover a field, and the runs of lines that are worth their seconds."""
