"""Recordings: lines that were taken once, where they lie, and how they serve later requests."""
