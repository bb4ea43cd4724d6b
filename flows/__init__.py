"""Prefect flows and the command line: settings, survey, train, trade-offs, receipt and report."""
