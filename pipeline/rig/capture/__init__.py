"""Captures of sweeps on both devices, with positions and times of their lines, as a source of lines."""

JOURNAL = "captures.jsonl"  # of what the rig has acknowledged, beside the files fetched from the camera
