"""The stages of a survey: functions that write one store each."""
