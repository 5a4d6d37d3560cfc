"""The light stage in asset coordinates, as the head sees it at each frame.

The head moves, the stage does not. Everything is told in the head's rest pose: at the frame of light i, lamps and
cameras have moved by the inverse of the head's motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.artifacts import Camera
from pipeline.capture_artifacts import StageLight
from pipeline.transforms import F64, apply, inverse_rigid, matrix, project, rescale_camera, scale_of


@dataclass(frozen=True, slots=True)
class Rig:
    """lights: in the capture's order. position, axis (L, 3), strength (L, 3): at rest, asset coordinates. cameras (C);
    motion (L, 4, 4): of the head from its rest pose to the light's frame."""

    index: tuple[int, ...]
    position: F64
    axis: F64
    strength: F64
    cameras: tuple[Camera, ...]
    motion: F64

    @property
    def towards(self) -> F64:
        """(L, 3) unit directions against which the lamps shine: from the stage's centre to each."""
        return -self.axis

    def lamps(self) -> tuple[F64, F64]:
        """(L, 3) positions and (L, 3) axes of the lamps, as the head sees them."""
        back = np.stack([inverse_rigid(m) for m in self.motion])
        position = np.einsum("lij,lj->li", back[:, :3, :3], self.position) + back[:, :3, 3]
        return position, np.einsum("lij,lj->li", back[:, :3, :3], self.axis)

    def eyes(self) -> F64:
        """(C, L, 3) centres of the cameras, as the head sees them."""
        back = [inverse_rigid(m) for m in self.motion]
        centres = np.array([matrix(c.world_from_cam)[:3, 3] for c in self.cameras]).reshape(-1, 3)
        return np.stack([apply(b, centres) for b in back], 1)

    def pixels(self, camera: int, light: int, points: F64) -> tuple[F64, F64]:
        """(N, 2) positions in the picture of a camera at a light's frame, and (N,) depths of points (N, 3) at rest."""
        shot = self.cameras[camera]
        cam_from_rest = inverse_rigid(matrix(shot.world_from_cam)) @ self.motion[light]
        return project(matrix(shot.K), cam_from_rest, np.array(shot.distortion), points)

    def without(self, lights: Sequence[int]) -> Rig:
        """The rig without some lights, given by their place."""
        kept = [i for i in range(len(self.index)) if i not in set(lights)]
        return Rig(tuple(self.index[i] for i in kept), self.position[kept], self.axis[kept], self.strength[kept],
                   self.cameras, self.motion[kept])  # fmt: skip


def rig_of(
    lights: Sequence[StageLight], cameras: Sequence[Camera], capture_from_asset: F64, motion: Mapping[int, F64]
) -> Rig:
    """The rig of a capture's lights. capture_from_asset: 4x4 similarity; motion: 4x4 in asset coordinates by frame.

    Intensities are divided by the squared scale: distances in asset coordinates then give the capture's radiance.
    """
    asset_from_capture = matrix(np.linalg.inv(capture_from_asset))
    scale = scale_of(capture_from_asset)
    turn = asset_from_capture[:3, :3] * scale
    position = apply(asset_from_capture, matrix([light.position for light in lights]))
    axis = np.array([light.axis for light in lights]) @ turn.T
    strength = np.array([light.intensity for light in lights]) / scale**2
    at = np.stack([motion.get(light.frame, np.eye(4)) for light in lights])
    return Rig(tuple(light.index for light in lights), position, axis, strength, tuple(cameras), at)


def moved_camera(camera: Camera, motion: F64) -> F64:
    """4x4 world_from_cam of a camera as the head in its rest pose sees it after its motion."""
    return rescale_camera(inverse_rigid(motion), matrix(camera.world_from_cam))
