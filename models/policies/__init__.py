"""Attention policies: which patches a fine look is worth, by the model, by the coarse image, or by nothing."""
