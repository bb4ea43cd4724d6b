"""Scores of maps, with their uncertainty."""
