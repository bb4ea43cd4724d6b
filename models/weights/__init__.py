"""Files of tensors: our own sealed weights, and other people's, read without running anything."""
