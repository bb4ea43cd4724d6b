"""Scores of maps and of placements, with their uncertainty."""
