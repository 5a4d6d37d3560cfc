"""Photos of the toy capture, and the toy stages in place of the real ones."""

from __future__ import annotations

from pathlib import Path

import pytest

import stages.capture.scan
from stages import registry
from tests.support.toy_stages import TOYS, source


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg"):
        (folder / name).write_bytes(name.encode() * 10)
    return folder


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "REGISTRY", TOYS)
    monkeypatch.setattr(stages.capture.scan, "scan_capture", source)
