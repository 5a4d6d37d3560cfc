"""PREFECT_API_URL names a server that does not answer: the user is told what to start or to unset."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import StageError
from tests.support.points import PATIENCE
from workflows.server.environment import unanswered

TOY = Path(__file__).parents[1] / "support" / "toy_neuface.py"


@pytest.mark.slow
def test_a_run_says_that_the_server_does_not_answer(photos: Path, child_environment: dict[str, str]) -> None:
    environment = {**child_environment, "PREFECT_API_URL": "http://127.0.0.1:9/api"}
    command = [sys.executable, str(TOY), "run", str(photos), "--out", str(photos.parent / "out")]
    child = subprocess.run(command, env=environment, text=True, capture_output=True, timeout=PATIENCE)
    assert child.returncode == 1 and "Traceback" not in child.stderr
    assert "the Prefect server does not answer" in child.stderr and "http://127.0.0.1:9/api" in child.stderr
    assert "unset PREFECT_API_URL" in child.stderr


def test_which_faults_are_the_servers() -> None:
    away = unanswered(RuntimeError("Failed to reach API at http://127.0.0.1:9/api/"))
    assert away is not None and "does not answer" in str(away)
    shut = unanswered(Exception("Client error '401 Unauthorized' for url 'http://127.0.0.1:4200/api'"))
    assert shut is not None and "PREFECT_API_AUTH_STRING" in str(shut)
    assert unanswered(RuntimeError("a bug")) is None and unanswered(ValueError("Failed to reach API")) is None
    known = StageError("Unauthorized", where="", value="", limit="", remedy="")
    assert unanswered(known) is None
