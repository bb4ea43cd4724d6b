"""Training: examples, objective, steps, checkpoints, and weights to start from."""
