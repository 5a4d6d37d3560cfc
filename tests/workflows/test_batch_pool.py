"""A batch on a Prefect server with Postgres and two workers, while a worker, the server and Postgres are killed.

Behind the real capture the stages are toys, so that it takes a minute; `NEUFACE_REAL_STAGES=1` takes all the real ones.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import sha256_of
from tests.support.facescape_tree import write_heads, write_tree
from tests.support.points import Point, hold, wait_for
from tests.support.servers import (
    LOGIN,
    PREFECT,
    Process,
    ask,
    free_port,
    guarded,
    postgres,
    postgres_programs,
    wait_healthy,
)
from workflows.server.environment import SLOTS_ON_DISK

TOY = Path(__file__).parents[1] / "support" / "toy_batch.py"
CAPTURES = {f"{s}/{e}": (s, e) != (2, "1_neutral") for s in (1, 2, 3) for e in ("1_neutral", "2_smile")}
REAL = bool(os.environ.get("NEUFACE_REAL_STAGES"))
STAGES = 9 if REAL else 3
SETTINGS = {
    "inverse_rendering.steps": 200, "inverse_rendering.batch": 512, "inverse_rendering.grid_cells": 48,
    "inverse_rendering.levels": 1, "inverse_rendering.hash_log2_size": 12, "inverse_rendering.hash_fine": 0.006,
    "surface.resolution": 48, "uv.target_faces": 1000, "uv.proxy_faces": 300, "bake.size": 256, "usd.preview_size": 64,
} if REAL else {"work.steps": 6}  # fmt: skip
SETS = [x for k, v in SETTINGS.items() for x in ("--set", f"{k}={v}")]
POINT = "fit.checkpoint" if REAL else "work.checkpoint@3"  # where a fit holds its slot
PHOTO = "1.png" if REAL else "1.jpg"  # the one that is cut off
PATIENCE = 1500 if REAL else 480  # seconds


def counts(tally: Path) -> Counter[str]:
    return Counter(tally.read_text().split("\n")[:-1])


def at_the_point(point: Point) -> list[int]:
    """Processes that live and are held there."""
    return [pid for pid in point.reached() if (Path("/proc") / str(pid)).is_dir()]


def damaged(store: Path) -> list[Path]:
    """Files of finished artifacts that are not what their manifests say."""
    found = []
    for manifest in store.glob("*/*/manifest.json"):
        for path, digest in hashes(json.loads(manifest.read_text())):
            if sha256_of(manifest.parent / path) != digest:
                found.append(manifest.parent / path)
    return found


def hashes(content: Any) -> Iterator[tuple[str, str]]:
    """(path, sha256) of every file that a manifest names."""
    if isinstance(content, dict) and {"path", "sha256"} <= content.keys():
        yield content["path"], content["sha256"]
    elif isinstance(content, dict | list):
        for value in content.values() if isinstance(content, dict) else content:
            yield from hashes(value)


def by_stage(tally: Counter[str]) -> Counter[str]:
    return Counter(line.split()[0] for line in tally.elements())


def call(environment: dict[str, str], *command: object, cwd: Path) -> None:
    done = subprocess.run([str(c) for c in command], env=environment, cwd=cwd, text=True, capture_output=True)
    assert done.returncode == 0, f"{command}: {done.stdout}\n{done.stderr}"


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Six captures, one of them cut off."""
    (write_heads if REAL else write_tree)(tmp_path / "tree", CAPTURES)
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
            SLOTS_ON_DISK[0]: SLOTS_ON_DISK[1],
            "NEUFACE_ROOTS": str(tmp_path),
            **guarded(),
            "NEUFACE_TALLY": str(tally),
            **(point := hold(POINT, tmp_path / "signs")).environment(),
        }
        ours = (repo / "workflows/prefect.yaml").read_text()
        (tmp_path / "prefect.yaml").write_text(ours.replace("workflows.flows.", "tests.support.toy_batch."))
        server = Process(environment, tmp_path / "server.log", tmp_path, PREFECT, "server", "start", "--host",
                         "127.0.0.1", "--port", port)  # fmt: skip
        workers = [Process(environment, tmp_path / f"worker{i}.log", tmp_path, PREFECT, "worker", "start", "--pool",
                           "heads", "--name", f"w{i}", "--limit", 1) for i in (1, 2)]  # fmt: skip
        batch = Process(environment, tmp_path / "batch.log", tmp_path, sys.executable, TOY, "batch", tree, "--out",
                        tmp_path / "out", "--server", "--lost-after", "10s", "--priority", "high", "--gpus", "2",
                        *SETS)  # fmt: skip
        with server:
            wait_healthy(url)
            call(environment, PREFECT, "work-pool", "create", "heads", "--type", "process",
                 "--base-job-template", repo / "workflows/pools/process.json", cwd=tmp_path)  # fmt: skip
            call(environment, PREFECT, "--no-prompt", "deploy", "--prefect-file", "prefect.yaml", "-n",
                 "local", cwd=tmp_path)  # fmt: skip
            with workers[0], workers[1], batch:
                store = tmp_path / "out/.store"
                wait_for(lambda: len(at_the_point(point)) == 2, PATIENCE)  # both workers are in a fit
                workers[0].kill()
                workers[0].start()
                point.release()
                wait_for(lambda: list((tmp_path / "out").glob("*/*/run.json")), PATIENCE)
                point.take_back()
                batch.kill()
                batch.start()  # joins the runs that it left
                wait_for(lambda: at_the_point(point), PATIENCE)  # a fit holds a slot while the server is away
                server.kill()
                database.restart()
                server.start()
                point.release()
                assert batch.child is not None
                code = batch.child.wait(PATIENCE)
            runs = ask(url, "/flow_runs/filter", {"limit": 50}, LOGIN)
            limits = ask(url, "/v2/concurrency_limits/filter", {}, LOGIN)
            queues = ask(url, "/work_pools/heads/queues/filter", {}, LOGIN)
    notify = (tmp_path / "batch.log").read_text()
    assert code == 1, notify
    summary = json.loads((tmp_path / "out/batch/summary.json").read_text())
    assert summary["counts"] == {"done": 5, "unusable": 0, "failed": 1, "submitted": 0, "waiting": 0}, notify
    failed = summary["captures"][0]
    assert failed["name"] == "2/1_neutral" and PHOTO in failed["fault"]
    assert "2/1_neutral: trying again (capture)" not in notify, "a torn photo stays torn"
    ended = [
        notify.count(f"2/1_neutral: {how}") for how in ("FAILED", "trying again (lost)")
    ]  # lost: the server's kill
    assert ended[0] >= 1 and sum(ended) == failed["attempts"], notify
    assert len(list((tmp_path / "out").glob("*/*/asset/*.usd"))) == 5
    assert len(list(store.glob("*/*/manifest.json"))) == 5 * STAGES and damaged(store) == []
    assert max(c["attempts"] for c in summary["captures"]) >= 2, "the killed worker's capture was tried again"
    assert all(r["idempotency_key"].startswith("neuface-") for r in runs)
    assert len(runs) == sum(c["attempts"] for c in summary["captures"]), "the batch that was killed joined its runs"
    assert "CRASHED" in {r["state_type"] for r in runs}
    assert {r["work_queue_name"] for r in runs} == {"high"}
    assert [(q["name"], q["priority"]) for q in queues if q["name"] == "high"] == [("high", 1)]
    assert [(x["name"], x["limit"]) for x in limits] == [("neuface-fits", 2)]
    undisturbed_tally = tmp_path / "tally alone"
    undisturbed = [sys.executable, TOY, "batch", tree, "--out", tmp_path / "alone", "--workers", "2", *SETS]
    subprocess.run(
        [str(c) for c in undisturbed], env={**environment, "NEUFACE_TALLY": str(undisturbed_tally)}, timeout=PATIENCE
    )
    once = counts(tally)
    assert set(once.values()) == {1} and once.total() == 5 * STAGES, "no stage came to its end twice"
    assert by_stage(once) == by_stage(counts(undisturbed_tally))
