"""Offer the flow to a Prefect server from this process: `python -m workflows.deployments`.

For a work pool and workers on several machines use `prefect deploy` with workflows/prefect.yaml instead.
"""

from workflows.flows import capture_to_asset

NAME = "local"


def main() -> None:
    """Serve the deployment capture-to-asset/local, one run at a time, until stopped."""
    capture_to_asset.serve(name=NAME, limit=1, description="Photos of a head in, a relightable USD asset out.")


if __name__ == "__main__":
    main()
