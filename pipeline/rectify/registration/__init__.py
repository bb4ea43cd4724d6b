"""Registration of sweeps: shifts of overlaps, solved over all of them, and fine sweeps on the mosaic."""
