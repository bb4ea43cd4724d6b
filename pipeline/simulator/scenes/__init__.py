"""What the simulated rig looks at."""
