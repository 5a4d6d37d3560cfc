"""Photo detail and eyes under a flash, whose light differs from photo to photo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from pipeline.artifacts import Camera
from pipeline.fields.protocol import F32, Material
from pipeline.images import write_exr
from pipeline.lighting.moving import MovingLight, Standpoint
from pipeline.maths import sh
from pipeline.maths.light_frame import FLASH
from pipeline.meshes import F64, Mesh
from pipeline.transforms import matrix, pixel_centres, rays, rows
from pipeline.visibility import FittedPhoto
from stages.bake import detail, detail_views
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.textured_ball import camera_on_orbit

RADIUS, PIXELS, FOCAL = 0.04, 200, 500.0


def lamp() -> MovingLight:
    d = torch.tensor([[0.0, -0.2, -1.0]], dtype=torch.float64)
    c = np.repeat(sh.sh_basis(d / d.norm(), 6).numpy().T, 3, 1).astype(np.float32)
    still = np.zeros((4, 3), np.float32)
    still[0] = 0.3
    return MovingLight(FLASH, 0.25, 3 * c, still)


def freckles(p: F64) -> F64:
    return 0.1 * np.sin(2 * np.pi / 0.007 * p).prod(1)[:, None]


class Flashed(AnalyticField):
    """A matt ball of albedo 0.4 under a flash."""

    @property
    def moving_light(self) -> MovingLight:  # type: ignore[override]
        return lamp()

    @property
    def light(self) -> F32:
        return lamp().still()

    def material(self, points: F32) -> Material:
        one = np.ones(len(points), np.float32)
        return Material(np.full((len(points), 3), 0.4, np.float32), 0 * one, one[:, None], 0.1 * one)

    def basis(self, wo: F32, normal: F32) -> F32:
        return np.ones((len(wo), 1), np.float32)


def camera(index: int) -> Camera:
    K = np.array([[FOCAL, 0, PIXELS / 2], [0, FOCAL, PIXELS / 2], [0, 0, 1]])
    pose = camera_on_orbit(45.0 * index, 25.0 * (-1) ** index, 0.25, np.zeros(3))
    return Camera(index=index, name=f"{index}.exr", width=PIXELS, height=PIXELS, K=rows(K), world_from_cam=rows(pose),
                  distortion=(0.0,) * 5)  # fmt: skip


def photograph(c: Camera) -> F32:
    """Albedo over pi times the flash's irradiance at each pixel's point."""
    o, d = rays(matrix(c.K), matrix(c.world_from_cam), np.zeros(5), pixel_centres(PIXELS, PIXELS))
    b = d @ o
    inside = b * b - (o @ o - RADIUS**2)
    p = o + (-b - np.sqrt(inside.clip(0)))[:, None] * d
    n = (p / np.linalg.norm(p, axis=1, keepdims=True)).astype(np.float32)
    e = lamp().irradiance(p.astype(np.float32), n, Standpoint.of(matrix(c.world_from_cam)))
    rgb = np.where((inside > 0)[:, None], (0.4 + freckles(p)) / np.pi * e.clip(0), 0)
    return rgb.reshape(PIXELS, PIXELS, 3).astype(np.float32)


@pytest.fixture(scope="module")
def ball() -> Mesh:
    made = trimesh.creation.icosphere(5, RADIUS)
    return Mesh(*(np.asarray(a, np.float32) for a in (made.vertices, made.vertex_normals)), made.faces.astype(np.int32))


def test_detail_is_found_under_a_light_that_moves(ball: Mesh, tmp_path: Path) -> None:
    field = Flashed(sphere(RADIUS), half=(0.05, 0.05, 0.05), rank=1)
    views = []
    for i in range(8):
        write_exr(tmp_path / f"{i}.exr", photograph(camera(i)))
        views.append(FittedPhoto(camera(i), None, tmp_path / f"{i}.exr"))
    responses = np.tile(np.eye(3), (8, 1, 1))
    photos = detail_views.read_photos(views, responses, ball, 1e-4, lambda *_: None)
    x, n = ball.vertices.astype(np.float64), ball.normals.astype(np.float64)
    corner = np.tile(np.arange(len(x), dtype=np.int32)[:, None], (1, 3))
    weights = np.tile(np.float32([1, 0, 0]), (len(x), 1))
    albedo, even = np.full((len(x), 3), 0.4, np.float32), np.ones((len(x), 3), np.float32)
    points = detail.Points(x, n, corner, weights, albedo, detail.shade(field.light, n, even))
    found = detail.prepare(field, ball, points, photos, "exponential", lambda *_: None)
    assert found.relative.shape == (8, len(x), 3)
    added, support = found.added(points)
    seen = support > 0.3
    assert seen.mean() > 0.4
    left = np.sqrt(((added - freckles(x))[seen] ** 2).mean())
    plain = np.sqrt((freckles(x)[seen] ** 2).mean())
    assert left < 0.5 * plain
    wrong, _ = detail.Detail(photos, found.gloss, found.bands, np.zeros((0, 0, 3), np.float32)).added(points)
    assert np.sqrt(((wrong - freckles(x))[seen] ** 2).mean()) > 1.3 * left


def test_relative_light_is_that_of_each_photo(ball: Mesh) -> None:
    """Straight below the camera the still light of the front and that of the photo are compared by hand."""
    field = Flashed(sphere(RADIUS), half=(0.05, 0.05, 0.05), rank=1)
    row = np.zeros((1, 30))
    pose = matrix(camera(2).world_from_cam)
    row[0, :12] = np.linalg.inv(pose)[:3].ravel()
    row[0, 27:30] = pose[:3, 3]
    relative = detail.relative_light(field, ball, row)[0]
    even = np.ones((len(ball.vertices), 3), np.float32)
    still = detail.shade(field.light, ball.normals, even)
    own = lamp().irradiance(ball.vertices, ball.normals, Standpoint.of(pose)) / np.pi
    bright = own[:, 0] > 0.2 * own.max()
    np.testing.assert_allclose((relative * still)[bright], own[bright], rtol=1e-4)
    assert relative.min() > 0 and detail.relative_light(AnalyticField(sphere(RADIUS)), ball, row).shape == (0, 0, 3)
