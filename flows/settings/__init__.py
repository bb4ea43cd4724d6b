"""Settings of a survey: every key with its range and unit, read from one TOML file and flags."""
