"""Scenes for the simulated rig."""
