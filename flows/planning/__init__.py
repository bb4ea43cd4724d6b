"""Plan of a survey: lines of its passes, partial scans, and what the network reads."""
