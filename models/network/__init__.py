"""The segmenter: overview and full network, how they read a scene, and what that costs."""
