"""Fields on a schedule: deployments of the survey, served by Prefect."""
