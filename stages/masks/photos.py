"""The photos of a capture as inputs of the masks: read when they are needed, as many at once as memory has room for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pipeline.artifacts import Camera, CameraSet, FileRef, Located
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.errors import StageError
from pipeline.images import read_alpha, read_encoded
from stages.masks.region import F32, U8, Disc, eight_bit, region
from stages.masks.sources import PhotoToMask

ROOM, PIXEL_BYTES = 3 << 30, 40  # memory for the photos at work at once; bytes that a pixel of them takes at most
MOST_AT_ONCE = 8


def photos_of(capture: Located[Capture], poses: CameraSet) -> list[tuple[PhotoToMask, Camera]]:
    """Each view that has a camera, with it."""
    by_index = {v.index: v for v in capture.artifact.views}
    out = []
    for camera in poses.cameras:
        v = by_index[camera.index]
        disc = region(camera, poses.roi_radius) or Disc(v.width / 2, v.height / 2, min(v.width, v.height) / 2, 0)
        out.append(
            (
                PhotoToMask(
                    v.index,
                    v.name,
                    camera,
                    disc,
                    v.holdout,
                    _reader(capture, v.image),
                    _mask_reader(capture, v),
                    None if v.plate is None else _reader(capture, v.plate),
                ),
                camera,
            )
        )
    return out


def _reader(capture: Located[Capture], picture: FileRef) -> Callable[[], U8]:
    return lambda: eight_bit(read_encoded(capture.path(picture)))


def _mask_reader(capture: Located[Capture], view: CaptureView) -> Callable[[], F32] | None:
    if view.mask is None:
        return None
    path = capture.path(view.mask)

    def read() -> F32:
        alpha = read_alpha(path)
        if alpha.shape != (view.height, view.width):
            raise StageError("the mask does not have the photo's size", where=f"view {view.index} ({view.name})",
                             value=f"{alpha.shape[1]} x {alpha.shape[0]}", limit=f"{view.width} x {view.height}",
                             remedy="give a mask of the photo's size")  # fmt: skip
        return alpha

    return read


def at_once(views: Sequence[CaptureView], cores: int) -> int:
    """How many photos are worked on at once: one a core, but no more than memory has room for."""
    largest = max((v.width * v.height for v in views), default=1)
    return max(1, min(MOST_AT_ONCE, cores, ROOM // (PIXEL_BYTES * largest)))
