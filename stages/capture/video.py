"""Frames of a video: the given number, spread over the camera's path, each the sharpest of its part of the path.

Equal times do not give equally different views, because the camera pauses and hurries. So the path is measured by the
sum of optical flow and divided into equal parts. Of each part the frame with the strongest fine detail is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import StageError
from pipeline.images import write_png
from pipeline.sharpness import detail

F64 = npt.NDArray[np.float64]
SMALL, FLOW = 480, 160  # pixels, longest edge of the reduced frames: for sharpness, for motion
MIN_FRAMES = 8  # fewer frames have less information than photos
STILL = 0.02  # of the reduced frame's longest edge: a video with less motion in total shows one view only


def frames_of(video: Path, folder: Path, count: int, tick: Callable[[int, int], None]) -> list[Path]:
    """Write at most `count` frames of a video into `folder` as PNG, named by frame number. tick: done, total.

    Raises StageError if the video can't be read, is too short, or shows no motion.
    """
    total = 0
    sharpness, motion = [], []
    before = None
    for number, frame in _frames(video):
        total = number + 1
        tick(number, max(total, _length(video)))
        grey = _reduced(frame, SMALL)
        sharpness.append(detail(grey))
        flow = _reduced(grey, FLOW)
        motion.append(0.0 if before is None else _moved(before, flow))
        before = flow
    if total < MIN_FRAMES:
        raise StageError("the video can't be read" if total == 0 else "the video is too short", where=video.name,
                         value=f"{total} frames", limit=f"at least {MIN_FRAMES}",
                         remedy="record the subject from all around for half a minute, as MP4 (H.264)")  # fmt: skip
    if sum(motion) < STILL * FLOW:
        raise StageError("the camera does not move in the video", where=video.name,
                         value=f"{sum(motion):.2f} pixels of {FLOW}",
                         limit="a camera that moves around the subject",
                         remedy="walk around the subject while recording")  # fmt: skip
    wanted = set(choose(np.array(sharpness), np.array(motion), count))
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for number, frame in _frames(video):
        if number in wanted:
            written.append(folder / f"{number:06d}.png")
            write_png(written[-1], frame[..., ::-1].astype(np.float32) / 255)
    return written


def choose(sharpness: F64, motion: F64, count: int) -> list[int]:
    """Numbers of the frames to take, ascending: the sharpest frame of each of `count` equal parts of the path.

    sharpness: (N,); motion: (N,) pixels, motion[i] is the path from frame i - 1 to i.
    """
    path = np.cumsum(motion)
    part = np.minimum((path / max(path[-1], 1e-12) * count).astype(int), count - 1)
    return [int(m[np.argmax(sharpness[m])]) for s in np.unique(part) for m in [np.flatnonzero(part == s)]]


def _frames(video: Path) -> Iterator[tuple[int, npt.NDArray[np.uint8]]]:
    """(number, (H, W, 3) BGR), rotated upright by the video's metadata."""
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    try:
        number = 0
        while True:
            ok, frame = capture.read()
            if not ok:
                return
            yield number, np.asarray(frame, np.uint8)
            number += 1
    finally:
        capture.release()


def _length(video: Path) -> int:
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    length = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    return max(length, 0)


def _reduced(image: npt.NDArray[np.uint8], edge: int) -> npt.NDArray[np.uint8]:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    scale = min(1.0, edge / max(grey.shape))
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def _moved(before: npt.NDArray[np.uint8], after: npt.NDArray[np.uint8]) -> float:
    """Mean length of the optical flow, pixels."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow = np.zeros((*before.shape, 2), np.float32)
    dis.calc(before, after, flow)
    return float(np.linalg.norm(flow, axis=2).mean())
