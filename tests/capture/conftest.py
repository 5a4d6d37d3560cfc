"""A small FaceScape folder and the capture stage without a store."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import Located
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from stages.capture.scan import scan_capture
from stages.capture.stage import Config, Inputs, run
from tests.support.light_stage import Stage, make_stage, write_stage
from tests.support.spread import made_once
from tests.support.textured_ball import camera_on_orbit, write_facescape

SIZE = (96, 80)
K = np.array([[150.0, 0, 49.0], [0, 151.0, 39.5], [0, 0, 1]])


@pytest.fixture
def facescape(tmp_path: Path) -> tuple[Path, dict]:
    """Six views on an arc, and the parameters as written."""
    poses = [camera_on_orbit(15.0 * i - 40, 10, 1.0, np.zeros(3)) for i in range(6)]
    folder = tmp_path / "capture"
    return folder, write_facescape(folder, poses, K, SIZE, pictures=False)


@pytest.fixture
def gather(tmp_path: Path) -> Callable[..., Located[Capture]]:
    """scan + run on a folder; settings by name."""

    def go(folder: Path, **settings: object) -> Located[Capture]:
        work = tmp_path / f"work{len(list(tmp_path.glob('work*')))}"
        work.mkdir()
        capture = run(Inputs(scan_capture(folder)), Config(**settings), Context(work, tmp_path))
        return Located(capture, work)

    return go


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A light stage's capture."""
    return made_once(tmp_path_factory, "light_stage", lambda folder: write_stage(folder, make_stage()))


@pytest.fixture
def capture(made: Path, tmp_path: Path) -> tuple[Path, Stage]:
    """A copy that a test may damage."""
    shutil.copytree(made, tmp_path / "capture")
    return tmp_path / "capture", make_stage()
