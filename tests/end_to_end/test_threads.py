"""The stages whose store key has no number of threads give the same bytes with one thread and with two."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline import threads
from stages.registry import REGISTRY
from tests.support.textured_ball import camera_on_orbit, write_facescape

SIZE, K = (320, 280), np.array([[700.0, 0, 160.0], [0, 700.0, 140.0], [0, 0, 1]])


@pytest.mark.slow
def test_one_thread_and_two(tmp_path: Path, repo: Path) -> None:
    """Photos alone, one held out, in processes of their own; files and manifests of every such stage."""
    folder = tmp_path / "ball"
    write_facescape(
        folder, [camera_on_orbit(12.0 * i - 42, 12.0 * (i % 2), 0.6, np.zeros(3)) for i in range(8)], K, SIZE
    )
    (folder / "params.json").unlink()
    alike = [s.name for s in REGISTRY if s.any_threads]
    assert alike == [s.name for s in REGISTRY[: len(alike)]] and "poses" in alike
    found = []
    for count in ("1", "2"):
        out = tmp_path / count
        done = subprocess.run(
            [sys.executable, "-m", "workflows.cli", "run", folder, "--out", out, "--until", alike[-1], "--force",
             "--holdout", "every:5:2", "--set", "capture.drop_blurred=false"],
            env={**os.environ, **dict.fromkeys(threads.NAMES, count), "PYTHONPATH": str(repo)}, cwd=repo,
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode in (0, 3), done.stderr
        files = [
            p for stage in alike for p in (out / ".store" / stage).rglob("*") if p.is_file() and p.name != "run.json"
        ]
        found.append({p.relative_to(out).as_posix(): p.read_bytes() for p in files if "lock" not in p.name})
    assert set(found[0]) == set(found[1]) and len(found[0]) > len(alike)
    assert [name for name in found[0] if found[0][name] != found[1][name]] == []
