"""Prefect's settings. They must be in the environment before Prefect is imported."""

from __future__ import annotations

import os

# Offline and quiet. Whoever sets one of these decides it; these are only defaults.
OFFLINE = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_LEVEL": "WARNING",
    "PREFECT_LOGGING_TO_API_WHEN_MISSING_FLOW": "ignore",
    "PREFECT_CLI_PROMPT": "false",
}
# Of a server: who holds a slot of a global limit. In memory, the default, a restart forgets it: the slot stays taken.
SLOTS_ON_DISK = ("PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE", "prefect.server.concurrency.lease_storage.filesystem")


# A fit keeps every core busy for minutes beside the server: with Prefect's own limits (seconds) a question of the
# database fails there, and the client gives up after five answers "try again".
PATIENT = {
    "PREFECT_SERVER_DATABASE_TIMEOUT": "60",
    "PREFECT_SERVER_DATABASE_CONNECTION_TIMEOUT": "60",
    "PREFECT_CLIENT_MAX_RETRIES": "10",
}


def defaults() -> None:
    """Quiet, offline and patient, unless the user set it."""
    for name, value in {**OFFLINE, **PATIENT}.items():
        os.environ.setdefault(name, value)


def has_server() -> bool:
    """Whether the user named a Prefect server. Without one no run needs Prefect."""
    return bool(os.environ.get("PREFECT_API_URL"))
