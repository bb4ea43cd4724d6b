"""Compute products of a map: spectral indices and areas."""
