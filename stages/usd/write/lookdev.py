"""Writes lookdev.usda: the component with its captured light and cameras.

Light and cameras are added to the component's own prim in a stronger layer (the component is a sublayer, not a
reference). So the file has one root prim and can be referenced, and NAME.usd has no lights and cameras.
"""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdRender

from pipeline.artifacts import Camera
from pipeline.lighting.moving import MovingLight
from pipeline.transforms import USD_CAM_FROM_OPENCV_CAM, matrix
from stages.usd.write.component import detached
from stages.usd.write.moving_light import add_moving_light

MAIN_CAMERA = "main_cam"
SENSOR_WIDTH = (
    0.36  # tenths of the scene's unit, as USD defines apertures: 36 mm; only the ratio to the focal length matters
)


def lookdev_layer(
    name: str,
    cameras: tuple[Camera, ...],
    holdout: frozenset[int],
    radius: float,
    moving: MovingLight | None = None,
) -> Sdf.Layer:
    """The layer. `radius`: of the region of interest around the origin, for the clipping ranges. moving: the light, if
    it moves with the camera."""
    stage = Usd.Stage.CreateInMemory()
    layer = stage.GetRootLayer()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    layer.defaultPrim = name
    layer.documentation = (
        "The captured head under its captured light, with the photos' cameras (without lens distortion)."
    )
    stage.OverridePrim(f"/{name}")
    UsdGeom.Scope.Define(stage, f"/{name}/lookdev")
    dome = UsdLux.DomeLight.Define(stage, f"/{name}/lookdev/captured_light")
    dome.CreateTextureFileAttr(Sdf.AssetPath("./environment.exr"))
    dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    dome.CreateIntensityAttr(1.0)
    dome.CreateColorAttr(Gf.Vec3f(1, 1, 1))
    UsdGeom.Scope.Define(stage, f"/{name}/lookdev/cameras")
    for camera in cameras:
        _camera(stage, f"/{name}/lookdev/cameras/view_{camera.index}", camera, camera.index in holdout, radius)
    _shown_first(stage, name, cameras, holdout)
    if moving is not None:
        add_moving_light(stage, f"/{name}/lookdev", moving, cameras)
    out = detached(stage)
    out.subLayerPaths.append(f"./{name}.usd")  # not before: a stage would search it in the working folder
    return out


def _shown_first(stage: Usd.Stage, name: str, cameras: tuple[Camera, ...], holdout: frozenset[int]) -> None:
    """Set the first camera: the most frontal held-out photo (if none is held out, the most frontal photo).

    There are several conventions: usdview uses a camera called main_cam, others the layer's cameraSettings, renderers
    the stage's render settings.
    """
    if not cameras:
        return
    of = [c for c in cameras if c.index in holdout] or list(cameras)
    first = max(of, key=lambda c: c.world_from_cam[2][3] / np.linalg.norm(np.array(c.world_from_cam)[:3, 3]))
    main = UsdGeom.Camera.Define(stage, f"/{name}/lookdev/cameras/{MAIN_CAMERA}")
    main.GetPrim().GetReferences().AddInternalReference(f"/{name}/lookdev/cameras/view_{first.index}")
    settings = UsdRender.Settings.Define(stage, f"/{name}/lookdev/render_settings")
    settings.CreateCameraRel().SetTargets([main.GetPath()])
    settings.CreateResolutionAttr(Gf.Vec2i(first.width, first.height))
    stage.SetMetadata("renderSettingsPrimPath", str(settings.GetPath()))
    stage.GetRootLayer().customLayerData = {"cameraSettings": {"boundCamera": str(main.GetPath())}}


def _camera(stage: Usd.Stage, path: str, camera: Camera, held_out: bool, radius: float) -> None:
    """A UsdGeomCamera with the frustum of K: fx, fy and principal point. The distortion is stored as metadata.

        horizontalAperture / focalLength = width / fx,   horizontalApertureOffset / focalLength = (width / 2 - cx) / fx
        verticalAperture / focalLength = height / fy,    verticalApertureOffset / focalLength = (cy - height / 2) / fy

    The vertical signs differ because USD's camera has +y up and the image's rows run down.
    """
    K = matrix(camera.K)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    focal = SENSOR_WIDTH * fx / camera.width
    out = UsdGeom.Camera.Define(stage, path)
    out.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    out.CreateFocalLengthAttr(focal)
    out.CreateHorizontalApertureAttr(SENSOR_WIDTH)
    out.CreateVerticalApertureAttr(focal * camera.height / fy)
    out.CreateHorizontalApertureOffsetAttr(focal * (camera.width / 2 - cx) / fx)
    out.CreateVerticalApertureOffsetAttr(focal * (cy - camera.height / 2) / fy)
    world_from_cam = matrix(camera.world_from_cam)
    distance = float(np.linalg.norm(world_from_cam[:3, 3]))
    near = max(distance - 2 * radius, 0.02 * radius)
    out.CreateClippingRangeAttr(Gf.Vec2f(near, distance + 4 * radius))
    usd = world_from_cam @ np.linalg.inv(USD_CAM_FROM_OPENCV_CAM)
    out.AddTransformOp().Set(Gf.Matrix4d(*usd.T.ravel().tolist()))  # USD multiplies row vectors from the left
    out.GetPrim().SetCustomDataByKey(
        "capture",
        {
            "photo": camera.name,
            "width": camera.width,
            "height": camera.height,
            "heldOut": held_out,
            "distortion_k1_k2_p1_p2_k3": " ".join(f"{x:.9g}" for x in camera.distortion),
        },
    )
