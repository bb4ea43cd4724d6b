"""Rasters whose pixels a survey takes as they are: opened as one field, and stored as means and patches."""
