"""Register sweeps: shifts in overlaps, solved over all of them, and fine sweeps on the mosaic."""
