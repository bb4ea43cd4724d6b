"""Simulated scenes and the simulated source that looks at them."""
