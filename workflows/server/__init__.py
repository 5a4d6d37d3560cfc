"""Prefect: the flows' parameters, stages as tasks, deployments, who may start what."""
