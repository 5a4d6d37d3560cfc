"""A light that moves with the camera: the renderer follows it, and lookdev.usda has it as lights that move."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom, UsdLux
from support.render_stand_ins import asset, sphere_points
from support.synthetic_asset import RADIUS

from pipeline.artifacts import Camera
from pipeline.images import read_linear
from pipeline.lighting.dome import light_from_environment
from pipeline.lighting.moving import FRONT, MovingLight
from pipeline.maths import sh
from pipeline.maths.light_frame import CAMERA, FLASH
from pipeline.transforms import rows
from stages.usd.render.camera import orbit_camera
from stages.usd.render.carried import Captured
from stages.usd.render.render import Renderer
from stages.usd.write.lookdev import lookdev_layer
from stages.usd.write.moving_light import DIMMEST, add_moving_light, lamp, write_domes

SIZE = 64


def lamp_light(direction: tuple[float, float, float], colour: tuple[float, float, float] = (1, 1, 1)) -> np.ndarray:
    """SH of order 10 of a lamp that gives this irradiance on a facing surface."""
    d = torch.tensor([direction], dtype=torch.float64)
    return (sh.sh_basis(d / d.norm(), 10).numpy().T * np.array(colour)).astype(np.float32)


def moving(frame: str, towards: tuple[float, float, float] = (0, 0, -1), ambient: float = 0.0) -> MovingLight:
    still = np.zeros((4, 3), np.float32)
    still[0] = ambient * np.sqrt(4 * np.pi)
    return MovingLight(frame, 0.5, lamp_light(towards), still)


@pytest.mark.parametrize("azimuth", [0.0, 1.3])
def test_a_flash_lights_the_sphere_from_every_camera(azimuth: float) -> None:
    """a / pi max(n . wo, 0) (d_0 / d)^2 + a ambient, from any side: closed form on the sphere."""
    made = replace(asset(), moving=moving(FLASH, ambient=0.1))
    view = orbit_camera(RADIUS, azimuth, SIZE)
    image = Renderer(made).render(view, samples=1, light=Captured(made))
    n, _, inside = sphere_points(view, SIZE)
    away = view.world_from_cam[:3, 3] - RADIUS * n
    distance = np.linalg.norm(away, axis=-1)
    cosine = np.maximum((n * away).sum(-1) / distance, 0)
    expected = 0.4 / np.pi * (cosine * (0.5 / distance) ** 2) + 0.4 * 0.1
    assert np.abs(image[..., 1] - expected)[inside].max() < 0.03 * expected[inside].max()


def test_another_light_stays_where_it_is() -> None:
    """A named light, and a captured light that stands still, are not carried."""
    view = orbit_camera(RADIUS, 1.3, SIZE)
    plain, carried = asset(), replace(asset(), moving=moving(CAMERA))
    even = np.zeros((4, 3), np.float32)
    even[0] = np.sqrt(4 * np.pi)
    a, b = (Renderer(x).render(view, samples=1, light=even) for x in (plain, carried))
    np.testing.assert_array_equal(a, b)
    assert np.abs(Renderer(carried).render(view, samples=1, light=Captured(carried)) - a).max() > 0.05


def camera(index: int, centre: tuple[float, float, float]) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = FRONT, centre
    return Camera(index=index, name=f"{index}.jpg", width=64, height=48, K=rows(np.diag([80.0, 80, 1])),
                  world_from_cam=rows(pose), distortion=(0.0,) * 5)  # fmt: skip


CAMERAS = (camera(3, (0, 0, 0.6)), camera(7, (0.1, 0, 0.7)))


def opened(light: MovingLight) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.Scope.Define(stage, "/head/lookdev")
    UsdLux.DomeLight.Define(stage, "/head/lookdev/captured_light")
    add_moving_light(stage, "/head/lookdev", light, CAMERAS)
    return stage


def test_the_flash_is_a_sphere_that_moves_with_the_camera() -> None:
    light = moving(FLASH, (0, -0.2, -1))
    stage = opened(light)
    variants = stage.GetPrimAtPath("/head/lookdev").GetVariantSet("light")
    assert variants.GetVariantNames() == ["front", "with_camera"] and variants.GetVariantSelection() == "front"
    assert not stage.GetPrimAtPath("/head/lookdev/camera_light")
    variants.SetVariantSelection("with_camera")
    bulb = UsdLux.SphereLight.Get(stage, "/head/lookdev/camera_light")
    for frame, one in enumerate(CAMERAS, 1):
        pose = np.array(UsdGeom.Xformable(bulb).ComputeLocalToWorldTransform(frame)).T
        # above the lens: y runs down in the camera's axes, and up in the asset's
        expected = np.array(one.world_from_cam)[:3, 3] + [0, 0.5 * 0.2, 0]
        np.testing.assert_allclose(pose[:3, 3], expected, atol=1e-4)
    hidden = UsdGeom.Imageable(stage.GetPrimAtPath("/head/lookdev/captured_light"))
    assert hidden.ComputeVisibility() == UsdGeom.Tokens.invisible
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1, 2)
    # its irradiance at a point in front of the lens, d_0 away, facing the lamp
    distance = np.hypot(0.5, 0.1)
    given = np.pi * bulb.GetIntensityAttr().Get() * (bulb.GetRadiusAttr().Get() / distance) ** 2
    assert given == pytest.approx(1, rel=1e-3)


def test_a_room_s_light_is_a_dome_that_turns_with_the_camera(tmp_path: Path) -> None:
    light = moving(CAMERA, (0.6, -0.5, -0.4), ambient=0.2)
    degree = np.sqrt(np.arange(121)).astype(int)[:, None]
    light = replace(light, coefficients=light.coefficients * np.exp(-degree * (degree + 1) / 8).astype(np.float32))
    stage = opened(light)
    stage.GetPrimAtPath("/head/lookdev").GetVariantSet("light").SetVariantSelection("with_camera")
    dome = UsdLux.DomeLight.Get(stage, "/head/lookdev/camera_light")
    files = write_domes(light, tmp_path, 128)
    assert [f.name for f in files] == ["environment_ambient.exr", "environment_camera.exr"]
    assert dome.GetTextureFileAttr().Get().path == "./environment_camera.exr"
    turn = np.array(UsdGeom.Xformable(dome).ComputeLocalToWorldTransform(1)).T[:3, :3]
    picture = light_from_environment(read_linear(files[1])).astype(np.float64)
    world = sh.rotated(picture, turn)  # the dome's picture in the asset's world at frame 1
    camera_axes = np.array(CAMERAS[0].world_from_cam)[:3, :3]
    expected = sh.rotated(light.coefficients.astype(np.float64), camera_axes)
    np.testing.assert_allclose(world[:9], expected[:9], atol=0.03)


def test_the_lamp_s_extremes() -> None:
    """No light, a uniform one, one from behind the subject, and a coloured one."""
    for coefficients in (np.zeros((1, 3), np.float32), np.zeros((9, 3), np.float32), lamp_light((0, 0, 1))):
        place, strength, colour = lamp(MovingLight(FLASH, 0.5, coefficients, np.zeros((1, 3), np.float32)))
        assert np.isfinite(place).all() and strength >= DIMMEST and np.isfinite(colour).all()
    red = MovingLight(FLASH, 0.5, lamp_light((0, 0, -1), (1.0, 0.5, 0.25)), np.zeros((1, 3), np.float32))
    np.testing.assert_allclose(lamp(red)[2], [1, 0.5, 0.25], rtol=1e-3)


def test_lookdev_without_a_moving_light_has_no_variants() -> None:
    layers = [lookdev_layer("head", CAMERAS, frozenset(), 0.1, light) for light in (None, moving(FLASH))]
    prims = [layer.GetPrimAtPath("/head/lookdev") for layer in layers]
    assert "light" not in prims[0].variantSets and "light" in prims[1].variantSets
