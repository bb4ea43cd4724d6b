"""Captures of sweeps on both devices: taken, tied to the mirror's positions and times, and given as a source."""

JOURNAL = "captures.jsonl"  # what the rig has acknowledged, beside the files fetched from the camera
