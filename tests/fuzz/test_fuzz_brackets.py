"""Damaged brackets.json files: a named error or a capture, in little time."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from hypothesis import given

from stages.capture.scan import scan_capture
from tests.support.fuzzing import bounded, halved
from tests.support.mutations import as_json, damaged, damages, nonsense, replaced
from tests.support.textured_ball import flat

LISTED = {
    "a": ["a0.png", "a1.png", "a2.png"],
    "b": {"photos": ["b0.png", "b1.png"], "seconds": [0.01, 0.04]},
    "c": ["c0.png", "c1.png"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views with two and three exposures."""
    out = tmp_path_factory.mktemp("c") / "capture"
    out.mkdir()
    for n, name in enumerate(("a0", "a1", "a2", "b0", "b1", "c0", "c1")):
        cv2.imwrite(str(out / f"{name}.png"), flat((64, 64), n))
    check(out, json.dumps(LISTED).encode())
    assert len(scan_capture(out).artifact.brackets) == 3  # it is whole
    return out


def check(folder: Path, data: bytes) -> None:
    (folder / "brackets.json").write_bytes(data)
    with bounded():
        source = scan_capture(folder).artifact
        source.canonical_json().encode()
        assert all(b.photo in {p.path for p in source.photos} for b in source.brackets)


@given(how=damages)
@halved
def test_damaged_bytes(folder: Path, how: list) -> None:
    check(folder, damaged(json.dumps(LISTED).encode(), how))


@given(how=nonsense)
@halved
def test_nonsense_in_json(folder: Path, how: list) -> None:
    check(folder, as_json(replaced(json.loads(json.dumps(LISTED)), how)))
