"""The segmenter in torch: overview and full network, attention policies, training, metrics, weights."""
