"""Captures for the poses stage, and the stage without a store."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.artifacts import CameraSet, Located
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from stages.capture.scan import scan_capture
from stages.capture.stage import Config as CaptureConfig
from stages.capture.stage import Inputs as CaptureInputs
from stages.capture.stage import run as run_capture
from stages.poses.stage import Config, Inputs, run


@pytest.fixture
def capture_of(tmp_path: Path) -> Callable[..., Located[Capture]]:
    """A folder through the capture stage."""

    def go(folder: Path, **settings: object) -> Located[Capture]:
        work = tmp_path / f"capture{len(list(tmp_path.glob('capture*')))}"
        work.mkdir()
        source = CaptureInputs(scan_capture(folder))
        return Located(run_capture(source, CaptureConfig(**settings), Context(work, tmp_path)), work)

    return go


@pytest.fixture
def place(tmp_path: Path) -> Callable[..., Located[CameraSet]]:
    """The poses stage on a capture; settings by name."""

    def go(capture: Located[Capture], cancelled: Callable[[], bool] = lambda: False, **settings: object):
        number = len(list(tmp_path.glob("poses*")))
        work, scratch = tmp_path / f"poses{number}", tmp_path / f"scratch{number}"
        work.mkdir()
        scratch.mkdir()
        context = Context(work, scratch, cancelled=cancelled)
        found = Located(run(Inputs(capture), Config(**settings), context), work)
        assert not list(scratch.iterdir())
        return found

    return go
