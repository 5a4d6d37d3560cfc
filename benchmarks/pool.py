"""The pool of docs/operations.md on this machine, with toy stages behind the real capture, for kill_pool and soak.

Postgres where it is installed, `neuface serve --server-only`, a pool of type process with the project's job template,
and the project's deployment, whose entrypoint is that of tests/support/toy_pool.py. Everything lies below one folder;
every process has the mark in its environment.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.error import HTTPError

from benchmarks.kill_matrix import MARK, ONE_THREAD
from tests.support.servers import PREFECT, Process, ask, free_port, postgres, postgres_programs, wait_healthy

ROOT = Path(__file__).resolve().parents[1]
ENTRY = "tests.support.toy_pool."
ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}
POLL = 0.2  # seconds between two questions
PATIENCE = 600.0  # seconds until a server that is away is given up


@dataclass
class Pool:
    """A running server with its pool and deployment. environment: of workers and of programs that submit runs."""

    folder: Path
    port: int
    database: str
    server: Process
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def url(self) -> str:
        """Of the server's API."""
        return f"http://127.0.0.1:{self.port}/api"

    def ask(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """One call with the server's login; repeated while the server is away or does not come to answer."""
        end = time.monotonic() + PATIENCE
        while True:
            try:
                return ask(self.url, path, body, self.environment["PREFECT_API_AUTH_STRING"])
            except HTTPError:
                raise
            except OSError:
                if time.monotonic() > end:
                    raise
            time.sleep(POLL)

    def call(self, *words: object) -> str:
        """One of Prefect's commands. Returns what it says."""
        done = subprocess.run([PREFECT, *map(str, words)], env=self.environment, cwd=self.folder, text=True,
                              capture_output=True)  # fmt: skip
        if done.returncode:
            raise SystemExit(f"{words}: {done.stdout}\n{done.stderr}")
        return done.stdout

    def deploy(self) -> None:
        """The pool and the deployment, as the document says."""
        text = (ROOT / "workflows/prefect.yaml").read_text().replace("workflows.flows.", ENTRY)
        (self.folder / "prefect.yaml").write_text(text)
        template = ROOT / "workflows/pools/process.json"
        self.call("work-pool", "create", "heads", "--type", "process", "--base-job-template", template)
        self.call("--no-prompt", "deploy", "--prefect-file", "prefect.yaml", "-n", "local")

    def submit(self, capture: Path, out: Path, store: Path, *settings: str) -> str:
        """`prefect deployment run`. The run's id."""
        known = {r["id"] for r in self.runs()}
        words = [f"capture={capture}", f"out={out}", f"store={store}", f"sets={json.dumps(settings)}"]
        end = time.monotonic() + PATIENCE
        while True:  # on a busy machine the client gives up, and the run may be there all the same
            try:
                self.call("deployment", "run", "capture-to-asset/local", *(x for w in words for x in ("--param", w)))
            except SystemExit:
                if time.monotonic() > end:
                    raise
            if new := [str(r["id"]) for r in self.runs() if r["id"] not in known]:
                return new[0]

    def runs(self) -> list[dict[str, Any]]:
        """The last 200 runs that the server knows."""
        found: list[dict[str, Any]] = self.ask("/flow_runs/filter", {"limit": 200, "sort": "START_TIME_DESC"})
        return found

    def run(self, number: str) -> dict[str, Any]:
        """One run, as the server sees it."""
        found: dict[str, Any] = self.ask(f"/flow_runs/{number}")
        return found

    def worker(self, name: str, **more: str) -> Process:
        """`prefect worker start` for one run at a time; not started. more: for its environment."""
        command = [PREFECT, "worker", "start", "--pool", "heads", "--name", name, "--limit", "1"]
        return Process({**self.environment, **more}, self.folder / f"{name}.log", self.folder, *command)


@contextmanager
def running(folder: Path, mark: str, **more: str) -> Iterator[Pool]:
    """A pool below `folder`, with its deployment; it ends with the block. mark: of its processes but Postgres; more:
    for their environment."""
    with _database() as (named, database):
        home, port = folder / "home", free_port()
        kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_") and k != "NEUFACE_STORE"}
        environment = {
            **kept, **ONE_THREAD, **database, MARK: mark, "PYTHONPATH": str(ROOT), "DO_NOT_TRACK": "1",
            "PATH": f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}",
            "PREFECT_HOME": str(folder / "prefect"), "NEUFACE_ROOTS": str(folder),
            "PREFECT_WORKER_QUERY_SECONDS": "2", **more,
        }  # fmt: skip
        command = (sys.executable, "-m", "workflows.cli", "serve", "--server-only", "--port", port, "--home", home)
        with Process(environment, folder / "server.log", folder, *command) as server:
            pool = Pool(folder, port, named, server)
            wait_healthy(pool.url)
            login = (home / "login").read_text().strip()
            pool.environment = {**environment, "PREFECT_API_URL": pool.url, "PREFECT_API_AUTH_STRING": login}
            pool.deploy()
            yield pool


@contextmanager
def _database() -> Iterator[tuple[str, dict[str, str]]]:
    if postgres_programs() is None:
        yield "SQLite", {}
        return
    with postgres() as cluster:
        yield "Postgres", {"PREFECT_API_DATABASE_CONNECTION_URL": cluster.url}


def wait_until(condition: Callable[[], Any], seconds: float) -> bool:
    """Whether something became true in this time."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(POLL)
    return True
