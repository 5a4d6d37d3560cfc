"""Prefect's settings. They must be in the environment before Prefect is imported."""

from __future__ import annotations

import os

from pipeline.errors import NeufaceError, StageError

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


def unanswered(error: Exception) -> StageError | None:
    """The error for the user where Prefect's client could not begin; None for any other. Prefect has one class for many
    faults, so that its words tell."""
    said = str(error)
    if isinstance(error, NeufaceError):
        return None
    if isinstance(error, RuntimeError) and "Failed to reach API" in said:
        what, remedy = "the Prefect server does not answer", "start it (neuface serve --server-only), or "
    elif "Unauthorized" in said:
        what, remedy = "the Prefect server wants a login", "set PREFECT_API_AUTH_STRING (docs/running.md), or "
    else:
        return None
    return StageError(
        what,
        where=f"PREFECT_API_URL {os.environ.get('PREFECT_API_URL', '')}",
        value=said.splitlines()[0],
        limit="a server that takes runs, or none named",
        remedy=f"{remedy}run here without one: unset PREFECT_API_URL",
    )
