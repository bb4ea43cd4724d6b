"""Choice of the effects that are computed: by bounds on what they would change, weighed by cost, and checked."""
