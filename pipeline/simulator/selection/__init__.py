"""Which effects are computed, and how: by bounds on what they would change, weighed by their cost, and checked."""
