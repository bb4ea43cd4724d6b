"""The two-scale segmenter: tokens, encoder, decoder, how it reads a scene, and what that costs."""
