"""A captured light that moves with the camera, as UsdLux lights in lookdev.usda.

The scope `lookdev` has the variant set `light`: `front`, the dome of environment.exr, which stands still (the light
while the camera is in front of the face), and `with_camera`: at frame k the light of the k-th camera in the scope
`cameras`. A flash is a small sphere beside the lens; another light is a dome that turns with the camera. The ambient
part is a dome that stands still.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from pipeline.artifacts import Camera
from pipeline.images import write_exr
from pipeline.lighting.dome import environment
from pipeline.lighting.moving import FRONT as UPRIGHT  # a dome has +Y up; a camera's y runs down, its z forward
from pipeline.lighting.moving import MovingLight
from pipeline.maths import sh
from pipeline.maths.light_frame import FLASH, TURNTABLE, level_axes
from pipeline.transforms import matrix

F64 = npt.NDArray[np.float64]

FRONT, WITH_CAMERA = "front", "with_camera"
AMBIENT_FILE, MOVING_FILE = "environment_ambient.exr", "environment_camera.exr"
BULB = 0.01  # of the distance: radius of the sphere
DIMMEST = 1e-6  # smallest irradiance of a flash that is written


def write_domes(moving: MovingLight, folder: Path, width: int) -> list[Path]:
    """Write the pictures of the ambient part and, without a flash, of the moving part in the camera's axes."""
    pictures = {AMBIENT_FILE: moving.ambient}
    if moving.frame != FLASH:
        pictures[MOVING_FILE] = sh.rotated(moving.coefficients.astype(np.float64), UPRIGHT).astype(np.float32)
    for name, light in pictures.items():
        write_exr(folder / name, environment(light, width), half=True)
    return [folder / name for name in pictures]


def add_moving_light(stage: Usd.Stage, scope: str, moving: MovingLight, cameras: tuple[Camera, ...]) -> None:
    """Add the variant set to the scope of a look-dev stage that has the dome `captured_light`."""
    prim = stage.GetPrimAtPath(scope)
    variants = prim.GetVariantSets().AddVariantSet("light")
    for name in (FRONT, WITH_CAMERA):
        variants.AddVariant(name)
    variants.SetVariantSelection(WITH_CAMERA)
    with variants.GetVariantEditContext():
        UsdGeom.Imageable(stage.OverridePrim(f"{scope}/captured_light")).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
        ambient = UsdLux.DomeLight.Define(stage, f"{scope}/ambient_light")
        ambient.CreateTextureFileAttr(Sdf.AssetPath(f"./{AMBIENT_FILE}"))
        ambient.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
        _carried(stage, f"{scope}/camera_light", moving, cameras)
    variants.SetVariantSelection(FRONT)
    if cameras:
        stage.SetStartTimeCode(1)
        stage.SetEndTimeCode(len(cameras))


def _carried(stage: Usd.Stage, path: str, moving: MovingLight, cameras: tuple[Camera, ...]) -> None:
    """The light, with one pose a photo."""
    place, axes = np.zeros(3), UPRIGHT
    if moving.frame == FLASH:
        bulb = UsdLux.SphereLight.Define(stage, path)
        place, strength, colour = lamp(moving)
        radius = BULB * moving.distance
        bulb.CreateRadiusAttr(radius)
        # a sphere of radiance L and radius r gives pi L r^2 / d^2 at the distance d
        bulb.CreateIntensityAttr(float(strength * moving.distance**2 / (np.pi * radius**2)))
        bulb.CreateColorAttr(Gf.Vec3f(*colour.tolist()))
        prim = bulb.GetPrim()
    else:
        dome = UsdLux.DomeLight.Define(stage, path)
        dome.CreateTextureFileAttr(Sdf.AssetPath(f"./{MOVING_FILE}"))
        dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
        prim = dome.GetPrim()
    local = np.eye(4)
    local[:3, :3], local[:3, 3] = axes, place
    op = UsdGeom.Xformable(prim).AddTransformOp()
    for frame, camera in enumerate(cameras, 1):
        pose = matrix(camera.world_from_cam)
        if moving.frame == TURNTABLE:
            pose[:3, :3] = level_axes(torch.from_numpy(pose[None, :3, :3].copy()))[0].numpy()
        pose = pose @ local
        op.Set(Gf.Matrix4d(*pose.T.ravel().tolist()), Usd.TimeCode(frame))
        prim.SetCustomDataByKey(f"photos:frame_{frame}", camera.name)


def lamp(moving: MovingLight) -> tuple[F64, float, F64]:
    """One small lamp in place of a flash: its place (3,) in the camera's axes, the irradiance at the distance d_0 on a
    surface that faces it, and its colour (3,), whose largest channel is 1.

    Place and strength are those of the vector irradiance: int L(d) d, which the coefficients of band 1 hold. The lamp
    stands beside the lens, in the plane z = 0, so that it lies in this direction from a point in front of the lens.
    """
    order = sh.order_of(torch.from_numpy(moving.coefficients))
    if order < 1:
        return np.zeros(3), DIMMEST, np.ones(3)
    y, z, x = moving.coefficients[1:4].astype(np.float64) * np.sqrt(4 * np.pi / 3)
    towards = np.stack([x, y, z])  # (3, colours)
    mean = towards.mean(1)
    length = float(np.linalg.norm(mean))
    flux = np.maximum((towards * mean[:, None]).sum(0) / max(length, 1e-12), DIMMEST)
    d = mean / max(length, 1e-12)
    if d[2] > -0.5:  # not near the lens: no lamp beside it has this direction
        return np.zeros(3), float(flux.max()), flux / flux.max()
    place = moving.distance * np.array([d[0], d[1], 0]) / -d[2]
    strength = float(flux.max()) * (1 + float((place**2).sum()) / moving.distance**2)  # it is farther away
    return place, strength, flux / flux.max()
