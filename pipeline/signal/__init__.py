"""Calibrate raw lines to scene values, and condense them to components."""
