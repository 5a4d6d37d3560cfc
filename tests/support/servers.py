"""Postgres, a Prefect server and workers as processes of a test, to be killed and started again."""

from __future__ import annotations

import base64
import json
import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.support.points import PATIENCE

PREFECT = str(Path(sys.executable).parent / "prefect")


def free_port() -> int:
    """A port of the loopback that nobody listens on now."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def postgres_programs() -> Path | None:
    """Where initdb and pg_ctl are: in PATH, or where Debian puts them."""
    found = shutil.which("initdb")
    places = [Path(found).parent] if found else sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    usable = [p for p in places if (p / "initdb").is_file() and (p / "pg_ctl").is_file()]
    if not usable or (os.getuid() == 0 and (not shutil.which("runuser") or not _owner())):
        return None
    return usable[0]


def _owner() -> str | None:
    """Postgres refuses to run as root: another user that this machine has."""
    names = {p.pw_name for p in pwd.getpwall()}
    return next((n for n in ("postgres", "nobody") if n in names), None)


class Postgres:
    """A cluster of its own in a temporary folder."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self.programs, self.folder, self.port = programs, folder, free_port()
        self.url = f"postgresql+asyncpg://tests@127.0.0.1:{self.port}/postgres"

    def call(self, program: str, *arguments: object) -> None:
        """Run one of Postgres's programs as a user that is not root."""
        command = [str(self.programs / program), *map(str, arguments)]
        if os.getuid() == 0:
            command = ["runuser", "-u", str(_owner()), "--", *command]
        subprocess.run(command, check=True, cwd=self.folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def restart(self) -> None:
        """As after a power cut."""
        self.call("pg_ctl", "-D", self.folder / "data", "-m", "immediate", "-w", "restart")


@contextmanager
def postgres() -> Iterator[Postgres]:
    """A running cluster."""
    programs = postgres_programs()
    assert programs is not None
    folder = Path(tempfile.mkdtemp(prefix="pg"))
    folder.chmod(0o755)
    if os.getuid() == 0:
        shutil.chown(folder, str(_owner()))
    cluster = Postgres(programs, folder)
    data = folder / "data"
    try:
        cluster.call("initdb", "-D", data, "-U", "tests", "-A", "trust", "--no-sync", "-E", "UTF8")
        options = f"-p {cluster.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories={folder} -c fsync=off"
        cluster.call("pg_ctl", "-D", data, "-o", options, "-l", folder / "log", "-w", "start")
        yield cluster
    finally:
        with suppress(subprocess.CalledProcessError):
            cluster.call("pg_ctl", "-D", data, "-m", "immediate", "-w", "stop")
        shutil.rmtree(folder, ignore_errors=True)


class Process:
    """A program with its children, which go when it goes."""

    def __init__(self, environment: dict[str, str], log: Path, cwd: Path, *command: object) -> None:
        self.environment, self.log, self.cwd, self.command = environment, log, cwd, [str(c) for c in command]
        self.child: subprocess.Popen[bytes] | None = None

    def start(self) -> Process:
        """Start it (again)."""
        with self.log.open("ab") as stream:
            self.child = subprocess.Popen(
                self.command,
                env=self.environment,
                cwd=self.cwd,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return self

    def kill(self) -> None:
        """SIGKILL for it and all that it started. Only once: the number of a process that is gone may be another's."""
        child, self.child = self.child, None
        if child is not None:
            for pid in [child.pid, *descendants(child.pid)]:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            child.wait()

    def __enter__(self) -> Process:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.kill()


def descendants(pid: int) -> list[int]:
    """Every process below `pid`."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            parents.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    found, wanted = [], [pid]
    while wanted:
        below = parents.get(wanted.pop(), [])
        found += below
        wanted += below
    return found


LOGIN = "tests:secret"  # of the servers that tests start
# Seconds between two questions to one. Each takes a token, which the server writes into its database: many at once keep
# others from writing there, and Prefect's clients then wait twice as long after each of ten attempts.
ASKED_EVERY = 1.0


def guarded() -> dict[str, str]:
    """Environment of a server behind a login, and of its clients, as docs/operations.md has it."""
    return {
        "PREFECT_SERVER_API_AUTH_STRING": LOGIN,
        "PREFECT_API_AUTH_STRING": LOGIN,
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": "http://127.0.0.1:4200",
        "PREFECT_SERVER_CSRF_PROTECTION_ENABLED": "true",
    }


def login_headers(url: str, login: str) -> dict[str, str]:
    """What a client of a guarded server sends: its login, and a token against forged requests."""
    basic = {"Authorization": f"Basic {base64.b64encode(login.encode()).decode()}"}
    with urllib.request.urlopen(urllib.request.Request(f"{url}/csrf-token?client=t", headers=basic)) as answer:
        token = json.loads(answer.read())["token"]
    return {**basic, "Prefect-Csrf-Token": token, "Prefect-Csrf-Client": "t"}


def ask(url: str, path: str, body: dict[str, Any] | None = None, login: str | None = None) -> Any:
    """One call of a Prefect server's API. On a busy machine it answers 503: try again, as Prefect's clients do."""
    data = None if body is None else json.dumps(body).encode()
    end = time.monotonic() + PATIENCE
    while True:
        try:
            headers = {"Content-Type": "application/json", **(login_headers(url, login) if login else {})}
            with urllib.request.urlopen(urllib.request.Request(f"{url}{path}", data, headers), timeout=60) as answer:
                return json.loads(answer.read())
        except urllib.error.HTTPError as e:
            if e.code != 503 or time.monotonic() > end:
                raise
            time.sleep(0.5)


def wait_healthy(url: str, seconds: float = PATIENCE) -> None:
    """Until the server answers."""
    end = time.monotonic() + seconds
    while True:
        try:
            ask(url, "/health")
            return
        except OSError:
            assert time.monotonic() < end, "the server did not start"
            time.sleep(0.3)
