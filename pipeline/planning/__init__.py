"""Plan captures: sweeps that cover a field, and the runs of lines with the most expected gain."""
