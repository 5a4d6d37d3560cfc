"""poses: checked photos in, cameras in asset coordinates out. Given cameras are used as they are, else solved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from pipeline.artifacts import Camera, CameraSet, Capture, Located
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import UsageError


@dataclass(frozen=True, slots=True)
class Inputs:
    """The checked photos."""

    capture: Located[Capture]


class Config(StageConfig):
    """Settings of the poses stage."""

    method: Literal["auto", "given", "colmap"] = Field(
        "auto",
        description="given: cameras of the capture; colmap: solved from the photos; auto: given if there are any",
    )
    seed: int = Field(0, ge=0, description="seed of every random choice")
    max_image_size: int = Field(1200, ge=200, description="longest edge, in pixels, at which features are looked for")
    max_features: int = Field(2500, ge=200, description="most features per photo")
    shared_intrinsics: Literal["auto", "yes", "no"] = Field(
        "auto", description="one lens model for all photos of equal size and EXIF; auto: as long as the photos agree"
    )
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV"] = Field(
        "SIMPLE_RADIAL", description="lens model: one radial term, or two radial and two tangential ones"
    )
    min_registered: float = Field(0.6, gt=0, le=1, description="least share of the photos that must find their place")


def run(inputs: Inputs, config: Config, context: Context) -> CameraSet:
    """Cameras around the subject.

    Raises:
        StageError: no cameras where they were asked for, or photos that can't be placed.
    """
    capture = inputs.capture.artifact
    with_camera = [v for v in capture.views if v.camera is not None]
    if config.method == "given" and len(with_camera) < len(capture.views):
        raise UsageError("the capture has no cameras", where="poses.method", value="given", limit="a camera for every "
                         "view (params.json)", remedy="use poses.method=auto or colmap")  # fmt: skip
    if config.method == "colmap" or len(with_camera) < len(capture.views):
        raise NotImplementedError("structure from motion")
    return given(capture)


def given(capture: Capture) -> CameraSet:
    """The capture's own cameras, moved to asset coordinates."""
    from pipeline.transforms import inverse_rigid, matrix, rows
    from stages.poses.normalise import normalise
    from stages.poses.place import in_asset

    cameras = []
    for v in capture.views:
        if v.camera is None:
            continue
        world_from_cam = inverse_rigid(matrix(v.camera.cam_from_world))
        k1, k2, p1, p2, k3 = v.camera.distortion
        cameras.append(
            Camera(index=v.index, name=v.name, width=v.width, height=v.height, K=v.camera.K,
                   world_from_cam=rows(world_from_cam), distortion=(k1, k2, p1, p2, k3))
        )  # fmt: skip
    found = normalise(cameras, given=True)
    return CameraSet(
        source="given",
        metric=found.metric,
        capture_from_asset=rows(found.capture_from_asset),
        roi_radius=found.roi_radius,
        cameras=in_asset(cameras, found.capture_from_asset),
        warnings=found.warnings,
    )


STAGE = Stage(name="poses", version=1, inputs=Inputs, config=Config, output=CameraSet, run=run)
