"""A recording as the source of a survey."""
