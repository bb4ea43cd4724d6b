"""Stored arrays of a survey: raw cubes and their spool, lookups, mosaics, patches, class maps."""
