"""Signs of life: a run tells its server every few seconds that its process lives (workflows/server/lost.py reads them).

A process of its own sends them, so that a library that blocks the interpreter for minutes does not silence a run. It
ends with the run's process, in whatever way that ends: its standard input is a pipe that only the run holds open.

python -m workflows.server.life ADDRESS    with the server's login in the environment. Standard library only.
"""

from __future__ import annotations

import base64
import os
import select
import ssl
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

BEAT = 10.0  # seconds between two signs
LOGIN = "NEUFACE_SIGN_LOGIN"  # USER:PASSWORD; not an argument, which every user of the machine could read


@contextmanager
def signs_of_life(run: Any) -> Iterator[None]:
    """While the block runs, tell the server that the flow run `run` is alive; nothing if there is no run or server."""
    address, login = _server()
    if run is None or address is None:
        yield
        return
    command = [sys.executable, "-m", "workflows.server.life", f"{address.rstrip('/')}/flow_runs/{run.id}"]
    child = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, LOGIN: login},
        start_new_session=True,  # a terminal's Ctrl-C is for the run
    )
    try:
        yield
    finally:
        child.kill()
        child.wait()
        if child.stdin is not None:
            child.stdin.close()


def _server() -> tuple[str | None, str]:
    """Address and login of the server of this process's run."""
    from prefect.settings import get_current_settings

    api = get_current_settings().api
    return api.url, api.auth_string.get_secret_value() if api.auth_string else ""


def request(address: str, login: str) -> urllib.request.Request:
    """The question about the run by which it tells that it lives."""
    headers = {"neuface-alive": "1"}
    if login:
        headers["Authorization"] = f"Basic {base64.b64encode(login.encode()).decode()}"
    return urllib.request.Request(address, headers=headers)


def tell(address: str, login: str, beat: float = BEAT) -> None:
    """Send a sign every `beat` seconds until the standard input ends. A server that is away is asked again."""
    while True:
        with suppress(OSError, ssl.SSLError, ValueError), urllib.request.urlopen(request(address, login), timeout=beat):
            pass
        ready, _, _ = select.select([sys.stdin], [], [], beat)
        if ready:  # nothing is ever written: this is the end
            return


if __name__ == "__main__":
    tell(sys.argv[1], os.environ.get(LOGIN, ""))
