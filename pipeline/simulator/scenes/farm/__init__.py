"""The built-in farm."""
