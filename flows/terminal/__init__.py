"""Terminal and process: progress, figures, safe text, signals, refusals of the machine."""
