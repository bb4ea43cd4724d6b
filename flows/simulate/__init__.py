"""Scans of a scene without a survey, and emulated rigs."""
