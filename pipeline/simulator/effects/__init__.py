"""Effects of optics, mirror, air, light and sensor: each a unit with a bound on what leaving it out would change."""
