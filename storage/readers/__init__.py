"""Readers of people's own files: scenes and cubes of any format, their labels and settings."""
