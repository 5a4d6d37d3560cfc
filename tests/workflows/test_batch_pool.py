"""A batch on a Prefect server with Postgres and two workers, while a worker, the server and Postgres are killed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.support.facescape_tree import write_tree
from tests.support.servers import (
    PREFECT,
    Process,
    ask,
    free_port,
    postgres,
    postgres_programs,
    wait_for,
    wait_healthy,
)

TOY = Path(__file__).parents[1] / "support" / "toy_batch.py"
CAPTURES = {f"{s}/{e}": (s, e) != (2, "1_neutral") for s in (1, 2, 3) for e in ("1_neutral", "2_smile")}
SLOW = ["--set", "work.steps=6", "--set", "work.pause=0.4"]


def counts(tally: Path) -> Counter[str]:
    return Counter(tally.read_text().split("\n")[:-1])


def call(environment: dict[str, str], *command: object, cwd: Path) -> None:
    done = subprocess.run([str(c) for c in command], env=environment, cwd=cwd, text=True, capture_output=True)
    assert done.returncode == 0, f"{command}: {done.stdout}\n{done.stderr}"


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Six captures, one of them cut off."""
    write_tree(tmp_path / "tree", CAPTURES)
    return tmp_path / "tree"


@pytest.mark.slow
@pytest.mark.skipif(postgres_programs() is None, reason="no Postgres here that a user other than root could run")
def test_a_night_with_a_killed_worker_server_and_database(
    tmp_path: Path, tree: Path, repo: Path, child_environment: dict[str, str]
) -> None:
    port, tally = free_port(), tmp_path / "tally"
    url = f"http://127.0.0.1:{port}/api"
    with postgres() as database:
        environment = {
            **child_environment,
            "PREFECT_API_URL": url,
            "PREFECT_HOME": str(tmp_path / "home"),
            "PREFECT_API_DATABASE_CONNECTION_URL": database.url,
            "PREFECT_WORKER_QUERY_SECONDS": "2",
            "NEUFACE_TALLY": str(tally),
        }
        ours = (repo / "workflows/prefect.yaml").read_text()
        (tmp_path / "prefect.yaml").write_text(ours.replace("workflows.flows.", "tests.support.toy_batch."))
        server = Process(environment, tmp_path / "server.log", tmp_path, PREFECT, "server", "start", "--host",
                         "127.0.0.1", "--port", port)  # fmt: skip
        workers = [Process(environment, tmp_path / f"worker{i}.log", tmp_path, PREFECT, "worker", "start", "--pool",
                           "heads", "--name", f"w{i}", "--limit", 1) for i in (1, 2)]  # fmt: skip
        batch = Process(environment, tmp_path / "batch.log", tmp_path, sys.executable, TOY, "batch", tree, "--out",
                        tmp_path / "out", "--server", "--lost-after", "6s", "--priority", "high", "--gpus", "2",
                        *SLOW)  # fmt: skip
        with server:
            wait_healthy(url)
            call(environment, PREFECT, "work-pool", "create", "heads", "--type", "process", cwd=tmp_path)
            call(environment, PREFECT, "--no-prompt", "deploy", "--prefect-file", "prefect.yaml", "-n",
                 "local", cwd=tmp_path)  # fmt: skip
            with workers[0], workers[1], batch:
                store = tmp_path / "out/.store"
                wait_for(lambda: list(store.glob("work/*.scratch/step.txt")), 120)
                workers[0].kill()
                workers[0].start()
                wait_for(lambda: list((tmp_path / "out").glob("*/*/run.json")), 120)
                server.kill()
                database.restart()
                server.start()
                assert batch.child is not None
                code = batch.child.wait(240)
            runs = ask(url, "/flow_runs/filter", {"limit": 50})
            limits = ask(url, "/v2/concurrency_limits/filter", {})
            queues = ask(url, "/work_pools/heads/queues/filter", {})
    said = (tmp_path / "batch.log").read_text()
    assert code == 1, said
    summary = json.loads((tmp_path / "out/batch/summary.json").read_text())
    assert summary["counts"] == {"done": 5, "failed": 1, "submitted": 0, "waiting": 0}, said
    failed = summary["captures"][0]
    assert failed["name"] == "2/1_neutral" and "1.jpg" in failed["fault"] and failed["attempts"] == 1
    assert len(list((tmp_path / "out").glob("*/*/asset/*.usd"))) == 5
    assert max(c["attempts"] for c in summary["captures"]) >= 2, "the killed worker's capture was tried again"
    assert "CRASHED" in {r["state_type"] for r in runs}
    assert {r["work_queue_name"] for r in runs} == {"high"}
    assert [(q["name"], q["priority"]) for q in queues if q["name"] == "high"] == [("high", 1)]
    assert [(x["name"], x["limit"]) for x in limits] == [("neuface-fits", 2)]
    alone = tmp_path / "tally alone"
    undisturbed = [sys.executable, TOY, "batch", tree, "--out", tmp_path / "alone", "--workers", "2"]
    subprocess.run([str(c) for c in undisturbed], env={**environment, "NEUFACE_TALLY": str(alone)}, timeout=120)
    assert counts(tally) == counts(alone)
    assert set(counts(tally).values()) == {1} and len(counts(tally)) == 15
