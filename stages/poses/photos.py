"""The photos as input of structure from motion: pixels, mask, focal length and lens group."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Located
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.images import read_alpha, read_encoded


@dataclass(frozen=True, slots=True)
class StoredPhoto:
    """A view of the capture. width, height: pixels. focal: pixels, from EXIF or a given camera. group: equal for photos
    of one lens."""

    width: int
    height: int
    focal: float | None
    group: str
    image: Path
    mask: Path | None

    def pixels(self) -> npt.NDArray[np.generic]:
        """(H, W, C) as stored."""
        return read_encoded(self.image)

    def inside(self) -> npt.NDArray[np.float32] | None:
        """(H, W) alpha of the subject, or None."""
        return None if self.mask is None else read_alpha(self.mask)


def photos_of(capture: Located[Capture]) -> list[StoredPhoto]:
    """One for each view, in the capture's order."""
    found = []
    for view in capture.artifact.views:
        focal, group = _lens(view)
        mask = capture.path(view.mask) if view.mask is not None else None
        found.append(StoredPhoto(view.width, view.height, focal, group, capture.path(view.image), mask))
    return found


def _lens(view: CaptureView) -> tuple[float | None, str]:
    """Focal length in pixels, if known, and the lens group.

    If given cameras are solved again, photos with equal intrinsics share a lens. The camera body is not used: in a rig
    each view has its own body, even if all have the same lens.
    """
    if view.camera is None:
        return view.focal_px, view.camera_group
    K = view.camera.K
    calibration = ", ".join(f"{v:.3f}" for v in (K[0][0], K[1][1], K[0][2], K[1][2], *view.camera.distortion))
    return K[0][0], f"{view.width}x{view.height} | {calibration}"
