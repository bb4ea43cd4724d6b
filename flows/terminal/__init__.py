"""What the terminal shows and what stops a command: progress, figures, safe text, signals, refusals of the machine."""
