"""The cameras of the 3D view, and small photos of some of them without lens distortion."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from pipeline.artifacts import Camera
from pipeline.fitted_cameras import cameras_of
from pipeline.images import read_encoded
from pipeline.transforms import centre_K_from_corner_K, matrix
from stages.report.capture_figures import camera_kinds, reduced
from stages.report.collect import Results, Started
from stages.report.pictures import U8, data_uri

PHOTO_SIDE = 720  # pixels
HELD_OUT, OTHERS = 8, 4  # photos in the page


def cameras_shown(r: Results) -> list[dict[str, Any]]:
    """Every camera in the order of its index: intrinsics in pixels of the photo, pose with OpenCV's axes, and `photo`
    as an address, if it is one of those that the page holds."""
    fitted_with = cameras_of(r.poses.artifact, r.inverse_rendering.artifact)
    cameras = sorted(fitted_with.cameras, key=lambda c: c.index)
    kinds, shown = camera_kinds(r), set(chosen(r))
    return [
        {
            "name": c.name, "kind": kinds[c.index], "width": c.width, "height": c.height,
            "fx": c.K[0][0], "fy": c.K[1][1], "cx": c.K[0][2], "cy": c.K[1][2],
            "world_from_cam": c.world_from_cam, "photo": _photo(r, c) if c.index in shown else None,
        }
        for c in cameras
    ]  # fmt: skip


def chosen(r: Started) -> list[int]:
    """Views whose photos the page holds: the first held-out ones, and some others, evenly spaced."""
    kinds = camera_kinds(r)
    held = [i for i in sorted(kinds) if kinds[i] == "held out"][:HELD_OUT]
    others = [i for i in sorted(kinds) if kinds[i] == "fitted"]
    picks = np.linspace(0, len(others) - 1, min(OTHERS, len(others))).round().astype(int)
    return held + [others[p] for p in picks]


def _photo(r: Started, camera: Camera) -> str:
    view = next(v for v in r.capture.artifact.views if v.index == camera.index)
    small = reduced(read_encoded(r.capture.path(view.image)), PHOTO_SIDE)
    return data_uri(straightened(small, camera), PHOTO_SIDE)


def straightened(small: U8, camera: Camera) -> U8:
    """A reduced photo (h, w, 3) as a camera with the same K without distortion would show it."""
    if not np.any(camera.distortion):
        return small
    h, w = small.shape[:2]
    K = centre_K_from_corner_K(np.diag([w / camera.width, h / camera.height, 1]) @ matrix(camera.K))
    return np.asarray(cv2.undistort(small, K, np.array(camera.distortion)), np.uint8)
