"""Rays, footprints and the weights by which samples see a scene."""
