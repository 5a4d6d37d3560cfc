"""What starts a run: the plan, the Prefect flow around it, the published folder, the command line."""
