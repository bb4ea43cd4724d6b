"""The two-scale segmenter in torch: tokens, encoder, decoder, attention policies, training, metrics, weights."""
