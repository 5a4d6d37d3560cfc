"""The cameras that the field was fitted with: those of the poses stage, except where the fit refined them."""

from __future__ import annotations

from pipeline.artifacts import Camera, CameraSet, FittedFace


def cameras_of(poses: CameraSet, fitted: FittedFace) -> CameraSet:
    """What every stage after the fit uses for a photo. Held-out photos keep the cameras of the poses stage."""
    refined = {c.index: c.world_from_cam for c in fitted.refined}

    def now(camera: Camera) -> Camera:
        pose = refined.get(camera.index)
        return camera if pose is None else camera.model_copy(update={"world_from_cam": pose})

    return poses.model_copy(update={"cameras": tuple(now(c) for c in poses.cameras)}) if refined else poses
