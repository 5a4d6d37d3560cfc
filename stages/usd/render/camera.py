"""Cameras of the renderer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.camera import PinholeCamera

F64 = npt.NDArray[np.float64]


def orbit_camera(
    radius: float, azimuth: float, size: int, centre: F64 | None = None, elevation: float = 0.0
) -> PinholeCamera:
    """A camera that looks at `centre` (3,) (default: the origin) and frames a sphere of `radius`. azimuth, elevation:
    radians; azimuth 0 is +Z. size: pixels along each side."""
    back = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    distance = 6 * radius
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, -np.cross(back, right), -back], 1)
    pose[:3, 3] = (np.zeros(3) if centre is None else centre) + back * distance
    focal = 0.5 * size / np.tan(np.arcsin(1 / 6)) / 1.02
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return PinholeCamera(K, pose, size, size)
