"""Publication of a survey, once: receipt, report, pictures."""
