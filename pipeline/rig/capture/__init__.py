"""Captures of sweeps on both devices: taken, tied to the mirror's positions and times, and given as a source."""
