"""Moves cameras from the capture's world to asset coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.artifacts import Camera
from pipeline.transforms import F64, matrix, rescale_camera, rows


def in_asset(cameras: Sequence[Camera], capture_from_asset: F64) -> tuple[Camera, ...]:
    """The same cameras with `world_from_cam` in asset coordinates. capture_from_asset: 4x4 similarity."""
    asset_from_capture: F64 = np.asarray(np.linalg.inv(capture_from_asset), np.float64)
    return tuple(
        c.model_copy(update={"world_from_cam": rows(rescale_camera(asset_from_capture, matrix(c.world_from_cam)))})
        for c in cameras
    )
