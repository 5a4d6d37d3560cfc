"""Cameras of the renderer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class View:
    """A camera of the renderer; K in pixels with the first pixel's centre at (0.5, 0.5)."""

    K: F64
    world_from_cam: F64
    width: int
    height: int
    distortion: F64 = field(default_factory=lambda: np.zeros(5))

    def scaled(self, width: int) -> View:
        """The same view with `width` columns; the height is rounded to whole pixels."""
        height = max(1, round(self.height * width / self.width))
        K = np.diag([width / self.width, height / self.height, 1]) @ self.K
        return View(K, self.world_from_cam, width, height, self.distortion)


def orbit_view(radius: float, azimuth: float, size: int, centre: F64 | None = None, elevation: float = 0.0) -> View:
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
    return View(K, pose, size, size)
