"""A moving light as plain numbers: against a point lamp, against the model that it comes from, and its file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.errors import StageError
from pipeline.fields.face import FaceModel, FittedField
from pipeline.fields.geometry import GridSdf
from pipeline.fields.spec import FaceSpec
from pipeline.lighting.dome import light_json, read_light, read_moving
from pipeline.lighting.moving import FRONT, MovingLight, Standpoint, from_stored
from pipeline.maths import sh
from pipeline.maths.light_frame import CAMERA, FLASH, Stations

RNG = np.random.default_rng(8)
NO_AMBIENT = np.zeros((4, 3), np.float32)


def lamp_light(direction: tuple[float, float, float], order: int = 10) -> np.ndarray:
    """SH of a lamp that gives the irradiance 1 on a facing surface."""
    d = torch.tensor([direction], dtype=torch.float64)
    return np.repeat(sh.sh_basis(d / d.norm(), order).numpy().T, 3, 1).astype(np.float32)


def test_a_flash_lights_as_a_point_lamp_at_the_lens() -> None:
    light = MovingLight(FLASH, 0.7, lamp_light((0, 0, -1)), NO_AMBIENT)
    eye = np.array([0.2, 0.1, 0.6])
    x = 0.1 * RNG.normal(size=(300, 3))
    n = RNG.normal(size=(300, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    away = eye - x
    d = np.linalg.norm(away, axis=1)
    cosine = (n * away).sum(1) / d
    found = light.irradiance(x.astype(np.float32), n.astype(np.float32), Standpoint(eye, FRONT))
    expected = np.maximum(cosine, 0) * (0.7 / d) ** 2
    assert np.abs(found - expected[:, None]).max() < 0.03 * expected.max()  # bands above 10 of the cosine


def moving_model(frame: str) -> FaceModel:
    torch.manual_seed(2)
    spec = FaceSpec(lo=(-0.14,) * 3, hi=(0.14,) * 3, views=1, light_frame=frame, light_distance=0.5, hash_levels=4,
                    hash_log2_size=8, width=16)  # fmt: skip
    model = FaceModel(spec, GridSdf(torch.zeros(9, 9, 9), torch.full((3,), -0.14), 0.035))
    with torch.no_grad():
        model.light.coefficients.add_(0.1 * torch.randn_like(model.light.coefficients))
        model.ambient.coefficients.add_(0.02 * torch.randn_like(model.ambient.coefficients))
    return model


@pytest.mark.parametrize("frame", [CAMERA, FLASH])
def test_the_plain_light_is_the_model_s(frame: str) -> None:
    """What the bake and the asset's renderer evaluate is what the fit rendered."""
    model = moving_model(frame)
    field = FittedField(model)
    light = field.moving_light
    assert light is not None and light.frame == frame
    x = 0.1 * RNG.normal(size=(40, 3)).astype(np.float32)
    n = RNG.normal(size=(40, 3)).astype(np.float32)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    axes = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    axes *= np.sign(np.linalg.det(axes))
    stand = Standpoint(np.array([0.1, 0.3, 0.4]), axes)
    away = (stand.centre - x).astype(np.float32)
    wo = away / np.linalg.norm(away, axis=1, keepdims=True)
    shaded = model.shade(*(torch.from_numpy(a) for a in (x, n, wo)), stand.stations(40))
    material = field.material(x)
    lit = light.irradiance(x, n, stand).clip(min=0)
    np.testing.assert_allclose(shaded.diffuse.detach(), material.albedo / np.pi * lit, atol=1e-5)
    strength = material.rho * (material.coefficients * field.basis(wo, n)).sum(1)
    gloss = strength[:, None] * light.reflected(x, n, material.inv_kappa, stand, "exponential")
    np.testing.assert_allclose(shaded.specular.detach(), gloss, atol=1e-5)


def test_a_moving_light_needs_the_cameras() -> None:
    model = moving_model(CAMERA)
    n = torch.tensor([[0.0, 0, 1]])
    with pytest.raises(AssertionError, match="cameras"):
        model.shade(0.1 * n, n, n)
    here = Stations(torch.tensor([[0.0, 0, 1]]), torch.eye(3)[None])
    assert model.shade(0.1 * n, n, n, here).total.isfinite().all()


def test_the_still_stand_in_is_the_light_of_a_camera_in_front() -> None:
    light = MovingLight(CAMERA, 1.0, lamp_light((0.3, -0.4, -1)), RNG.normal(size=(9, 3)).astype(np.float32))
    n = RNG.normal(size=(50, 3)).astype(np.float32)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    front = light.irradiance(0 * n, n, Standpoint(np.array([0, 0, 1.0]), FRONT))
    still = sh.irradiance(torch.from_numpy(light.still()), torch.from_numpy(n)).numpy()
    np.testing.assert_allclose(front, still, atol=1e-4)
    # the lamp stands above and to the right of the camera as it looks at the face: +x is the picture's right
    d = np.array([[0.3, 0.4, 1]]) / np.linalg.norm([0.3, 0.4, 1])
    none = replace(light, ambient=NO_AMBIENT).still().astype(np.float64)
    assert sh.irradiance(torch.from_numpy(none), torch.from_numpy(d)).numpy()[0, 0] == pytest.approx(1, abs=0.02)


def test_the_light_s_file(tmp_path: Path) -> None:
    light = MovingLight(FLASH, 0.7, lamp_light((0, 0.2, -1), 3), RNG.normal(size=(4, 3)).astype(np.float32))
    path = tmp_path / "light.json"
    path.write_text(light_json(light.still(), "exponential", light))
    again = read_moving(path)
    assert again is not None and (again.frame, again.distance) == (FLASH, 0.7)
    np.testing.assert_allclose(again.coefficients, light.coefficients, rtol=1e-6)
    np.testing.assert_allclose(again.ambient, light.ambient, rtol=1e-6)
    np.testing.assert_allclose(read_light(path), light.still(), rtol=1e-6)
    path.write_text(light_json(light.still(), "exponential"))
    assert read_moving(path) is None


@pytest.mark.parametrize(
    "change",
    [{"frame": "moon"}, {"distance": 0}, {"distance": float("nan")}, {"coefficients": [[1, 2, 3]] * 3},
     {"ambient": [[float("inf")] * 3]}, {"ambient": None}],
)  # fmt: skip
def test_a_damaged_file_is_named(tmp_path: Path, change: dict[str, object]) -> None:
    light = MovingLight(FLASH, 0.7, lamp_light((0, 0, -1), 2), NO_AMBIENT)
    with pytest.raises((ValueError, KeyError, TypeError)):
        from_stored({**light.stored(), **change})
    path = tmp_path / "light.json"
    path.write_text(json.dumps({"coefficients": [[0, 0, 0]], "moving": {**light.stored(), **change}}))
    with pytest.raises(StageError, match=r"light\.json"):
        read_moving(path)
