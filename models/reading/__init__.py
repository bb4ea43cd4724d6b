"""Trained weights on a scene: glance, regions of a large field."""
