"""Attention policies: which patches a fine look is worth, by the model, by saliency, or by nothing."""
