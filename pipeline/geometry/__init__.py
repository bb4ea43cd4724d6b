"""Model the mirror, the camera, scan paths and the scene grid in closed forms."""
