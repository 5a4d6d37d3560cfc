"""Offer the flows to a Prefect server from this process: `neuface serve`, for one workstation without a pool.

For a work pool and workers on several machines use `prefect deploy` with workflows/prefect.yaml instead.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.errors import StageError
from workflows.run.interrupt import PARENT
from workflows.server import access, environment

NAME, BATCH = "local", "batch-local"  # as in prefect.yaml
START = 180.0  # seconds that a server may take to start


def serve(
    host: str, port: int, limit: int, home: Path, notify: Callable[[str], None], roots: Sequence[str] = ()
) -> int:
    """Serve both deployments until stopped; with a server of its own unless PREFECT_API_URL names one.

    roots: folders that runs may read and write; default $NEUFACE_ROOTS, else the current folder.
    """
    environment.defaults()
    access.set_roots(roots)
    os.environ[PARENT] = str(os.getpid())  # its runs end with this process
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job inherits it ignored
    if environment.has_server():
        return _serve(limit, notify)
    with _server(host, port, home) as login:
        os.environ["PREFECT_API_URL"] = f"http://{_reachable(host)}:{port}/api"
        if login is not None:
            notify(f"the page asks for a login: it is in {login}. Programs need it in {access.CLIENT_LOGIN}")
        return _serve(limit, notify)


def _serve(limit: int, notify: Callable[[str], None]) -> int:
    from prefect import serve as serve_all
    from prefect.types.entrypoint import EntrypointType

    from workflows.flows import capture_to_asset, facescape_batch

    notify(f"serving capture-to-asset/{NAME} and facescape-batch/{BATCH} from {os.environ['PREFECT_API_URL']}")
    notify(f"runs may use {os.environ[access.ROOTS]}")
    shared: Any = {"tags": ["neuface"], "entrypoint_type": EntrypointType.MODULE_PATH}  # from any working folder
    served: Any = (
        capture_to_asset.to_deployment(NAME, concurrency_limit=limit, **shared),
        facescape_batch.to_deployment(BATCH, concurrency_limit=1, **shared),
    )
    serve_all(*served, limit=limit + 1)  # a batch waits for its captures: it must not hold the slot they need
    return 0


@contextmanager
def _server(host: str, port: int, home: Path) -> Iterator[Path | None]:
    """A Prefect server as a child process, behind a login. Returns the file of the login.

    It listens on this machine only, unless `host` is another address, and ends with this process.
    """
    home.mkdir(parents=True, exist_ok=True, mode=0o700)
    os.environ.setdefault("PREFECT_HOME", str(home))
    os.environ.setdefault(*environment.SLOTS_ON_DISK)
    login = access.lock_server(home, {f"http://{h}:{port}" for h in (_reachable(host), "127.0.0.1", "localhost")})
    command = ["-m", "prefect", "server", "start", "--host", host, "--port", str(port)]
    log = home / "server.log"
    with log.open("ab") as stream:
        child = subprocess.Popen(
            [sys.executable, "-m", "workflows.server.kept_child", str(os.getpid()), *command],
            stdout=stream,
            stderr=stream,
            start_new_session=True,  # a terminal's Ctrl-C is for this process, which then ends the server
        )
    try:
        _wait_for(child, f"http://{_reachable(host)}:{port}/api/health", log)
        yield login
    finally:
        child.terminate()
        try:
            child.wait(20)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def _reachable(host: str) -> str:
    """An address to call a server by that listens on `host`."""
    return {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)


def _wait_for(child: subprocess.Popen[bytes], url: str, log: Path) -> None:
    end = time.monotonic() + START
    while child.poll() is None and time.monotonic() < end:
        try:
            with urllib.request.urlopen(url, timeout=5):
                return
        except (urllib.error.URLError, OSError):
            time.sleep(0.3)
    raise StageError(
        "the Prefect server did not start",
        where=log,
        value="it ended" if child.poll() is not None else f"no answer in {START:.0f} s",
        limit="an answer from its health page",
        remedy="read its log; another program may use the port: choose one with --port",
    )
