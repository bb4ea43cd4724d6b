"""Compute products of a map: spectral indices, regions, prescriptions, areas."""
