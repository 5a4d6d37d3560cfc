"""A Prefect server of ours: behind a guard (workflows/server/guard.py), and with an eye on lost runs.

python -m workflows.server.own_server HOST PORT PATIENCE NAMES...    in an environment that access.lock_server made
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterable
from contextlib import AbstractContextManager

from workflows.server import access, environment

LOCAL = ("127.0.0.1", "localhost", "[::1]")  # names by which a machine calls itself


def reachable(host: str) -> str:
    """An address to call a server by that listens on `host`."""
    return {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)


def names_of(host: str, more: Iterable[str] = ()) -> list[str]:
    """Every name by which a server that listens on `host` may be called; `more` are the user's, the first of them is
    the one that its page uses."""
    return list(dict.fromkeys((*more, reachable(host), *LOCAL)))


def prepare(host: str, port: int, names: Iterable[str]) -> None:
    """Prefect's settings of such a server, which must be in the environment before Prefect is imported."""
    environment.defaults()
    os.environ.setdefault(*environment.SLOTS_ON_DISK)
    os.environ.setdefault("PREFECT_UI_API_URL", f"http://{next(iter(names))}:{port}/api")
    os.environ["PREFECT_SERVER_API_HOST"], os.environ["PREFECT_SERVER_API_PORT"] = host, str(port)


def run_server(host: str, port: int, names: list[str], patience: float) -> None:
    """Serve until a signal ends it."""
    os.umask(0o077)  # records of runs are for their owner
    prepare(host, port, names)
    import uvicorn
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.server.api.server import create_app

    from workflows.server.guard import Guard, Signs
    from workflows.server.lost import Lost, watch

    def connect() -> AbstractContextManager[SyncPrefectClient]:
        login = os.environ.get(access.SERVER_LOGIN)
        return SyncPrefectClient(f"http://{reachable(host)}:{port}/api", auth_string=login)

    signs, stop = Signs(), threading.Event()
    origins = [o for o in os.environ.get(access.ORIGINS, "").split(",") if o]
    guarded = Guard(create_app(final=True), names, origins, signs)
    watcher = threading.Thread(target=watch, args=(Lost(connect, signs, patience), stop), name="lost runs", daemon=True)
    watcher.start()
    try:
        uvicorn.run(guarded, host=host, port=port, log_level="warning", server_header=False)
    finally:
        stop.set()


if __name__ == "__main__":
    run_server(sys.argv[1], int(sys.argv[2]), sys.argv[4:], float(sys.argv[3]))
