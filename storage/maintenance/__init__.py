"""Verifying, repairing and clearing an archive."""
