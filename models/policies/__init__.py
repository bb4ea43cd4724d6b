"""Attention policies: which patches to read in full, by the model, the coarse image or nothing; placements compared."""
