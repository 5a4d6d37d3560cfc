"""A calibrated camera in plain arrays: projection, rays, resizing."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.transforms import inverse_rigid, matrix, project, rays

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """K (3, 3) in pixels, the first pixel's centre at (0.5, 0.5); world_from_cam (4, 4), OpenCV axes; distortion (5,)
    k1 k2 p1 p2 k3."""

    K: F64
    world_from_cam: F64
    width: int
    height: int
    distortion: F64 = field(default_factory=lambda: np.zeros(5))

    @classmethod
    def of(cls, camera: Camera, world_from_cam: F64 | None = None) -> PinholeCamera:
        """A manifest's camera; world_from_cam (4, 4): where it stands, if not there."""
        pose = matrix(camera.world_from_cam) if world_from_cam is None else world_from_cam
        lens = np.asarray(camera.distortion, np.float64)
        return cls(matrix(camera.K), pose, camera.width, camera.height, lens)

    @property
    def eye(self) -> F64:
        """(3,) the centre of projection."""
        return np.asarray(self.world_from_cam[:3, 3], np.float64)

    def scaled(self, width: int) -> PinholeCamera:
        """The same camera with `width` columns; the height is rounded to whole pixels."""
        height = max(1, round(self.height * width / self.width))
        K = np.diag([width / self.width, height / self.height, 1]) @ self.K
        return PinholeCamera(K, self.world_from_cam, width, height, self.distortion)

    def pixels(self, points: F64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """(N, 2) column and row of the pixel of each point (N, 3), and (N,) whether it is inside the picture."""
        uv, depth = project(self.K, inverse_rigid(self.world_from_cam), self.distortion, points)
        inside = (depth > 0) & (uv >= 0).all(1) & (uv < (self.width, self.height)).all(1)
        return np.where(inside[:, None], uv, 0).astype(np.int64), inside

    def rays(self, uv: F64) -> tuple[F64, F64]:
        """Origin (3,) and unit directions (N, 3) through positions (N, 2) in the picture."""
        return rays(self.K, self.world_from_cam, self.distortion, uv)
