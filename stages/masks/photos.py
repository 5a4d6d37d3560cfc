"""The photos of a capture as inputs of the masks: read when they are needed, as many at once as memory has room for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pipeline.artifacts import Camera, CameraSet, FileRef, Located
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.errors import StageError
from pipeline.images import read_alpha, read_encoded
from stages.masks.region import F32, U8, Disc, eight_bit, region
from stages.masks.sources import PhotoToMask

ROOM, PIXEL_BYTES = 3 << 30, 40  # memory for the photos at work at once; bytes that a pixel of them takes at most
MOST_AT_ONCE = 8
FLOATS = (".exr", ".tif", ".tiff")  # formats that may hold linear floats
WHITE_OF = 12  # photos that decide the white of floats
BRIGHTEST = 0.99  # this quantile of a photo's values is its white, as for features
ENOUGH = 1000  # pixels along the longer edge for that


def photos_of(
    capture: Located[Capture], poses: CameraSet, check: Callable[[], None] = lambda: None
) -> list[tuple[PhotoToMask, Camera]]:
    """Each view that has a camera, with it."""
    by_index = {v.index: v for v in capture.artifact.views}
    white = white_of(capture, [by_index[c.index] for c in poses.cameras], check)
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
                    _reader(capture, v.image, white),
                    _mask_reader(capture, v),
                    None if v.plate is None else _reader(capture, v.plate, white),
                ),
                camera,
            )
        )
    return out


def white_of(capture: Located[Capture], views: Sequence[CaptureView], check: Callable[[], None]) -> float:
    """The linear value that photos of floats show as white: one for the capture, so that brightness can be compared
    from photo to photo, and decided by photos of the fit. Files of floats have any unit. 1 if all photos are integers.
    """
    fitted = [v for v in views if not v.holdout and v.image.path.lower().endswith(FLOATS)]
    step = -(-len(fitted) // WHITE_OF)
    tops = []
    for view in fitted[:: step or 1]:
        check()
        image = read_encoded(capture.path(view.image))[..., :3]
        if np.issubdtype(image.dtype, np.floating):
            every = max(1, max(image.shape) // ENOUGH)
            tops.append(float(np.quantile(np.nan_to_num(image[::every, ::every]), BRIGHTEST)))
    found = float(np.median(tops)) if tops else 1.0
    return found if found > 0 else 1.0


def _reader(capture: Located[Capture], picture: FileRef, white: float) -> Callable[[], U8]:
    return lambda: eight_bit(read_encoded(capture.path(picture)), white)


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
