"""Publication of a survey: receipt, report, pictures, judged once the run is published."""
