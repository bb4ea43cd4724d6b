"""Mirror, camera, scan paths and grid: where each sample looks, in closed forms."""
