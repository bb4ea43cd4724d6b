"""Files of tensors: our own checksummed weights, and other people's, read without running anything."""
