"""Prefect's settings for a run on this machine alone. They must be in the environment before Prefect is imported."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

# Offline and quiet. Whoever sets one of these decides it; these are only defaults.
OFFLINE = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_EPHEMERAL_ENABLED": "true",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "180",
    "PREFECT_LOGGING_LEVEL": "WARNING",
    "PREFECT_LOGGING_TO_API_WHEN_MISSING_FLOW": "ignore",
    "PREFECT_CLI_PROMPT": "false",
}
# Of a server: who holds a slot of a global limit. In memory, the default, a restart forgets it: the slot stays taken.
SLOTS_ON_DISK = ("PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE", "prefect.server.concurrency.lease_storage.filesystem")


def defaults() -> None:
    """Quiet and offline, unless the user says otherwise."""
    for name, value in OFFLINE.items():
        os.environ.setdefault(name, value)


def settle(store: Path, out: Path) -> Path | None:
    """Prepare the environment for `neuface run`: a throw-away server unless PREFECT_API_URL names one.

    The server's home lies in the store, one for each `out`: two runs on one SQLite file lock each other out. Hands back
    the home of a server of our own.
    """
    defaults()
    if "PREFECT_API_URL" in os.environ:
        return None
    own = hashlib.sha256(str(out.resolve()).encode()).hexdigest()[:8]
    home = Path(os.environ.setdefault("PREFECT_HOME", str((store / ".prefect" / own).resolve())))
    home.mkdir(parents=True, exist_ok=True)  # Prefect makes the last folder only
    return home
