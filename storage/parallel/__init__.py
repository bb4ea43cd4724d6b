"""Blocks of work on threads, processes and clusters, to the same bytes."""
