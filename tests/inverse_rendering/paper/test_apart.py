"""A fit with our own settings loads nothing of the systems that the paper compares."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CHILD = """
import sys
from pathlib import Path
from pipeline.contract import Context
from pipeline.fields.face import load_face
from stages.inverse_rendering.stage import STAGE, Config, run
from tests.inverse_rendering.test_judge_stage import SETTINGS, inputs

def loaded():
    return sorted(m for m in sys.modules if {"pipeline", "stages"} & {m.split(".")[0]} and "paper" in m.split("."))

folder = Path(sys.argv[1])
settings = {**SETTINGS, "stereo": False, "steps": 4, "batch": 64}
run(inputs(folder), Config(**settings), Context(folder, folder))
load_face(folder / "field.npz")
print(len(loaded()), *loaded())
compared = STAGE.config_for("comparison")
run(inputs(folder), compared(**{**settings, "preset": "comparison", "shading": "phong"}), Context(folder, folder))
print(len(loaded()))
"""


@pytest.mark.slow
def test_our_own_fit_loads_nothing_of_the_papers_systems(repo: Path, tmp_path: Path) -> None:
    """In a process of its own: prediction, findings and reading the field again included. Phong, afterwards, does."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path)],
        cwd=repo,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": f"{repo}:{repo / 'tests'}", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    ours, phong = done.stdout.strip().splitlines()
    assert ours == "0"
    assert int(phong) > 0, "the question would be answered with 0 whatever is loaded"
