"""Trained weights on a scene: coarse prediction, regions of a large field."""
