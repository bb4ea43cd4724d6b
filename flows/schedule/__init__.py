"""Surveys on a schedule: due times and their ledger, one survey a rig, Prefect's server and its watcher, histories."""
