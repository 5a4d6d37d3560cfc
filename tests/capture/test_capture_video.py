"""Frames of a video: equal parts of the camera's path, the sharpest frame of each."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import StageError
from stages.capture.scan import scan_capture
from stages.capture.video import choose


def video(
    path: Path, shifts: list[int], soft: frozenset[int] = frozenset(), size: tuple[int, int] = (160, 120)
) -> Path:
    """A window that moves over a texture by so many pixels a frame; frames in `soft` are blurred."""
    random = np.random.default_rng(2)
    texture = cv2.GaussianBlur(random.random((size[1], size[0] + sum(shifts) + 1, 3)).astype(np.float32), (0, 0), 1.2)
    texture = (texture - texture.min()) / np.ptp(texture)
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, size)
    at = 0
    for i, shift in enumerate(shifts):
        at += shift
        frame = np.ascontiguousarray(texture[:, at : at + size[0]])
        writer.write(np.round((cv2.GaussianBlur(frame, (0, 0), 3) if i in soft else frame) * 255).astype(np.uint8))
    writer.release()
    return path


def test_choice_goes_by_way_and_sharpness() -> None:
    motion = np.array([0] + [0] * 9 + [1] * 10, float)  # stands still for ten frames, then walks
    sharp = np.ones(20)
    sharp[[3, 14]] = 2
    assert choose(sharp, motion, 2) == [3, 14]
    assert len(choose(sharp, motion, 10)) == 10
    assert choose(sharp, motion, 500)[0] == 3  # never more than there are


def test_a_video_becomes_photos(tmp_path: Path, gather) -> None:
    path = video(tmp_path / "c" / "clip.avi", [3] * 40, frozenset(range(1, 40, 2)))
    capture = gather(tmp_path / "c", frames=10).artifact
    assert capture.kind == "video" and len(capture.views) == 10
    assert all(v.index % 2 == 0 for v in capture.views) and capture.views[0].name.endswith(".png")
    steps = np.diff([v.index for v in capture.views])
    assert steps.min() >= 2 and steps.max() <= 8
    assert scan_capture(path).artifact.kind == "video"  # the video file itself may be given


def test_unusable_videos(tmp_path: Path, gather) -> None:
    video(tmp_path / "still" / "a.avi", [0] * 30)
    with pytest.raises(StageError, match="does not move"):
        gather(tmp_path / "still")
    video(tmp_path / "short" / "a.avi", [3] * 5)
    with pytest.raises(StageError, match="too short"):
        gather(tmp_path / "short")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "a.mp4").write_bytes(b"not a video")
    with pytest.raises(StageError, match="can't be read"):
        gather(tmp_path / "broken")
    video(tmp_path / "two" / "a.avi", [3] * 5)
    video(tmp_path / "two" / "b.avi", [3] * 5)
    with pytest.raises(StageError) as caught:
        scan_capture(tmp_path / "two")
    assert "2 videos" in caught.value.value and "a.avi" in caught.value.remedy
