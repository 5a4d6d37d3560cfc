"""`neuface serve`: the flows from this process, for one workstation without a pool; or a server alone.

For a work pool and workers on several machines use `neuface serve --server-only` and `prefect deploy` with
workflows/prefect.yaml instead.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import StageError
from workflows.run.interrupt import PARENT
from workflows.server import access, environment
from workflows.server.own_server import names_of, reachable, run_server

NAME, BATCH = "local", "batch-local"  # as in prefect.yaml
START = 180.0  # seconds that a server may take to start


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server of ours listens, and how it treats its runs.

    home: folder of its records. names: further host names by which it may be called. patience: seconds without a sign
    of life after which it marks a run as crashed.
    """

    host: str
    port: int
    home: Path
    names: tuple[str, ...] = ()
    patience: float = 60.0


def serve(address: Address, limit: int, notify: Callable[[str], None], roots: Sequence[str] = ()) -> int:
    """Serve both deployments until stopped; with a server of its own unless PREFECT_API_URL names one.

    roots: folders that runs may read and write; default $NEUFACE_ROOTS, else the current folder.
    """
    environment.defaults()
    access.set_roots(roots)
    os.environ[PARENT] = str(os.getpid())  # its runs end with this process
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job inherits it ignored
    if environment.has_server():
        return _serve(limit, notify)
    with _server(address, notify):
        os.environ["PREFECT_API_URL"] = f"http://{reachable(address.host)}:{address.port}/api"
        return _serve(limit, notify)


def serve_alone(address: Address, notify: Callable[[str], None]) -> int:
    """A server for the workers of a pool, without deployments of its own, until stopped."""
    _lock(address, notify)
    notify(f"a server for workers on {reachable(address.host)}, port {address.port}")
    run_server(address.host, address.port, names_of(address.host, address.names), address.patience)
    return 0


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


def _lock(address: Address, notify: Callable[[str], None]) -> None:
    """Give the server's environment a login and its home; tell where the login is."""
    address.home.mkdir(parents=True, exist_ok=True, mode=0o700)
    os.environ.setdefault("PREFECT_HOME", str(address.home))
    names = names_of(address.host, address.names)
    login = access.lock_server(address.home, [f"http://{name}:{address.port}" for name in names])
    if login is not None:
        notify(f"the page asks for a login: it is in {login}. Programs need it in {access.CLIENT_LOGIN}")


@contextmanager
def _server(address: Address, notify: Callable[[str], None]) -> Iterator[None]:
    """A server of ours as a child process.

    It listens on this machine only, unless `host` is another address, and ends with this process.
    """
    _lock(address, notify)
    command = ["-m", "workflows.server.own_server", address.host, str(address.port), str(address.patience)]
    command += names_of(address.host, address.names)
    log = address.home / "server.log"
    with log.open("ab") as stream:
        child = subprocess.Popen(
            [sys.executable, "-m", "workflows.server.kept_child", str(os.getpid()), *command],
            stdout=stream,
            stderr=stream,
            start_new_session=True,  # a terminal's Ctrl-C is for this process, which then ends the server
        )
    try:
        _wait_for(child, f"http://{reachable(address.host)}:{address.port}/api/health", log)
        yield
    finally:
        child.terminate()
        try:
            child.wait(20)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


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
