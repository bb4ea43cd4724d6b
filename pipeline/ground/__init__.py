"""Convert between the scene, the ground under a posed rig, and the pixels of a map."""
