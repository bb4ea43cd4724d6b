"""What a survey leaves for people: receipt, report, pictures, judged once the run is published."""
