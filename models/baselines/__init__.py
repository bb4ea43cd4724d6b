"""Networks that the two-scale segmenter is compared with."""
