"""Stored arrays of a survey: raw cubes and their spool, signal, geolocation grids, mosaics, class maps."""
