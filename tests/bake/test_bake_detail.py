"""Photo detail against a ball whose true albedo is a formula, photographed by closed-form rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from pipeline import raster, smoothing
from pipeline.artifacts import Camera
from pipeline.fields.protocol import F32, Material
from pipeline.images import linear_of, write_exr, write_png
from pipeline.meshes import F64, Charts, Mesh
from pipeline.transforms import inverse_rigid, matrix, pixel_centres, project, rays, rows
from pipeline.visibility import FittedPhoto, Occluder
from stages.bake import detail, detail_kernels, detail_views
from stages.bake.build import Baker, Photos
from stages.bake.texels import ALBEDO_RANGE
from stages.uv import unwrap
from stages.uv.config import Config
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.textured_ball import camera_on_orbit

RADIUS, SIZE, PIXELS, FOCAL = 0.04, 256, 160, 400.0
GLOSS = 0.05
DISTORTION = (0.04, -0.02, 0.001, -0.002, 0.01)


def smooth_albedo(p: F64) -> F64:
    """What the field knows."""
    return 0.4 + p @ np.array([[2.0, 0.5, 0.0], [0.0, 1.5, 0.5], [1.0, 0.0, 2.0]])


def freckles(p: F64) -> F64:
    """(N, 1) what only the photos know: waves of 7 mm, mean 0."""
    return 0.08 * np.sin(2 * np.pi / 0.007 * p).prod(1)[:, None]


class SmoothField(AnalyticField):
    """A ball with the smooth albedo, and a lobe that gives GLOSS of radiance everywhere: rho c B = GLOSS, light 1."""

    @property
    def light(self) -> F32:
        """Radiance 1 from everywhere: E = pi, S = 1."""
        out = np.zeros((121, 3), np.float32)
        out[0] = np.sqrt(4 * np.pi)
        return out

    def material(self, points: F32) -> Material:
        """See above."""
        one = np.ones(len(points), np.float32)
        albedo = smooth_albedo(points.astype(np.float64)).astype(np.float32)
        return Material(albedo, one, np.full((len(points), 1), GLOSS, np.float32), 0.1 * one)

    def basis(self, wo: F32, normal: F32) -> F32:
        """1."""
        return np.ones((len(wo), 1), np.float32)


def camera(index: int, azimuth: float, elevation: float) -> Camera:
    K = np.array([[FOCAL, 0, PIXELS / 2 + 3], [0, FOCAL, PIXELS / 2 - 2], [0, 0, 1]])
    pose = camera_on_orbit(azimuth, elevation, 0.25, np.zeros(3))
    return Camera(
        index=index, name=f"{index}.exr", width=PIXELS, height=PIXELS, K=rows(K), world_from_cam=rows(pose),
        distortion=DISTORTION,
    )  # fmt: skip


CAMERAS = [camera(i, 45.0 * i, 30.0 * (-1) ** i) for i in range(8)]


def photograph(c: Camera, albedo: Callable[[F64], F64], response: F64) -> F32:
    """(H, W, 3) mean over 3 x 3 rays a pixel of response (albedo + GLOSS); black beside the ball."""
    total = np.zeros((PIXELS * PIXELS, 3))
    for dx in (-1 / 3, 0, 1 / 3):
        for dy in (-1 / 3, 0, 1 / 3):
            place = pixel_centres(PIXELS, PIXELS) + [dx, dy]
            o, d = rays(matrix(c.K), matrix(c.world_from_cam), np.array(c.distortion), place)
            b = d @ o
            inside = b * b - (o @ o - RADIUS**2)
            p = o + (-b - np.sqrt(inside.clip(0)))[:, None] * d
            total += np.where((inside > 0)[:, None], (albedo(p) + GLOSS) @ response.T, 0) / 9
    return total.reshape(PIXELS, PIXELS, 3).astype(np.float32)


@dataclass
class Scene:
    field: SmoothField
    mesh: Mesh
    charts: Charts
    folder: Path
    responses: F64

    def shot(self, change: Callable[[int, F32], F32] = lambda i, photo: photo) -> list[FittedPhoto]:
        out = []
        for i, c in enumerate(CAMERAS):
            path = self.folder / f"{i}.exr"
            photo = photograph(c, lambda p: smooth_albedo(p) + freckles(p), self.responses[i])
            write_exr(path, change(i, photo))
            out.append(FittedPhoto(c, None, path))
        return out

    def baked(self, views: list[FittedPhoto], photos: bool = True) -> tuple[F64, F64, F32, F32]:
        """Points, albedo, support, unseen of the covered texels."""
        given = Photos(self.responses, "exponential") if photos else None
        found = Baker(self.field, self.mesh, self.charts, views, SIZE, lambda *_: None, given).tile(0)
        hits = raster.rasterise(raster.texel_corners(self.charts, SIZE), SIZE, 0, SIZE)
        x = (self.mesh.vertices[self.mesh.faces[hits.face]] * hits.weights[..., None]).sum(1).astype(np.float64)
        x *= RADIUS / np.linalg.norm(x, axis=1, keepdims=True)
        s = found.samples
        return x, np.asarray(s.albedo, np.float64), np.asarray(s.support), np.asarray(s.unseen)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    ball = trimesh.creation.icosphere(4, RADIUS)
    mesh = Mesh(*(np.asarray(a, np.float32) for a in (ball.vertices, ball.vertex_normals)), ball.faces.astype(np.int32))
    rng = np.random.default_rng(4)
    responses = np.eye(3) + 0.05 * rng.standard_normal((len(CAMERAS), 3, 3))
    charts = unwrap.unwrap(mesh, Config(texture_size=SIZE, padding=2))
    field = SmoothField(sphere(RADIUS), half=(0.05, 0.05, 0.05), rank=1)
    return Scene(field, mesh, charts, tmp_path_factory.mktemp("photos"), responses)


def error(x: F64, albedo: F64, where: np.ndarray) -> float:
    """Root mean square error, the true albedo being the smooth one and the freckles."""
    return float(np.sqrt(((albedo - smooth_albedo(x) - freckles(x))[where] ** 2).mean()))


@pytest.mark.slow
def test_detail_is_found_through_gloss_calibration_and_distortion(scene: Scene) -> None:
    x, albedo, support, unseen = scene.baked(scene.shot())
    seen = support > 0.5
    assert seen.mean() > 0.6 and unseen.mean() < 0.1
    plain = error(x, smooth_albedo(x), seen)
    assert plain > 0.02 and error(x, albedo, seen) < 0.45 * plain
    without = scene.baked(scene.shot(), photos=False)
    assert np.allclose(without[1][without[3] == 0], smooth_albedo(x)[without[3] == 0], atol=2e-3)


@pytest.mark.slow
def test_low_band_stays_the_fields_and_no_seam_shows(scene: Scene) -> None:
    """Photos of wrong exposure, each another: what they add has no mean, and does not step where photos change."""
    gains = 1 + 0.2 * np.linspace(-1, 1, len(CAMERAS))
    x, albedo, support, _ = scene.baked(scene.shot(lambda i, photo: photo * np.float32(gains[i])))
    added = albedo - smooth_albedo(x)
    seen = support > 0.5
    octant = (x > 0) @ np.array([1, 2, 4])
    means = np.array([added[seen & (octant == k)].mean(0) for k in range(8)])
    assert np.abs(means).max() < 0.012  # an exposure of 20 % would be 0.09
    assert error(x, albedo, seen) < 0.75 * error(x, smooth_albedo(x), seen)


@pytest.mark.slow
def test_one_bad_photo_does_little(scene: Scene) -> None:
    """A photo with a white bar across it, as of something in front of the head."""

    def barred(i: int, photo: F32) -> F32:
        out = photo.copy()
        if i == 0:
            out[76:82, 30:130] = 3.0
        return out

    x, albedo, support, _ = scene.baked(scene.shot(barred))
    seen = support > 0.5
    clean = scene.baked(scene.shot())[1]
    assert np.abs(albedo - clean)[seen].mean() < 0.006
    assert error(x, albedo, seen) < 0.6 * error(x, smooth_albedo(x), seen)


def test_places_that_no_photo_saw_follow_what_is_around(scene: Scene) -> None:
    views = scene.shot()[:1]
    x, albedo, support, unseen = scene.baked(views)
    toward = x @ matrix(views[0].camera.world_from_cam)[:3, 3]
    back = toward < -0.3 * np.linalg.norm(x[0]) * 0.25
    assert back.sum() > 1000 and unseen[back].min() > 0.999 and support[back].max() == 0
    front = unseen == 0
    assert (albedo[back] > albedo[front].min(0) - 1e-3).all() and (albedo[back] < albedo[front].max(0) + 1e-3).all()
    assert (albedo >= ALBEDO_RANGE[0]).all()


@pytest.mark.parametrize("offset", [0.0, 0.7])
def test_points_are_looked_up_where_the_camera_projects_them(scene: Scene, tmp_path: Path, offset: float) -> None:
    """A photo whose colours are its pixels' places gives back the projection, lens distortion included."""
    c = CAMERAS[1]
    place = pixel_centres(PIXELS, PIXELS).reshape(PIXELS, PIXELS, 2) / PIXELS
    write_exr(tmp_path / "0.exr", np.concatenate([place, np.ones((PIXELS, PIXELS, 1))], -1).astype(np.float32))
    photos = detail_views.read_photos(
        [FittedPhoto(c, None, tmp_path / "0.exr")], np.eye(3)[None], scene.mesh, 1e-4, lambda *_: None
    )
    n = scene.mesh.vertices.astype(np.float64) / RADIUS
    x = (RADIUS + 1e-5 * offset) * n
    nothing, zero = np.zeros((len(x), 3), np.float32), np.zeros((len(x), 3), np.int32)
    out, cosines = np.zeros((len(x), 3), np.float32), np.zeros(len(x), np.float32)
    detail_kernels.residual(
        photos.cameras, 0, photos.pixels, photos.depth, photos.clipped, x, n, zero, nothing, nothing[:1], nothing,
        np.full_like(nothing, 10), out, cosines,
    )  # fmt: skip
    world_from_cam = matrix(c.world_from_cam)
    uv, _ = project(matrix(c.K), inverse_rigid(world_from_cam), np.array(c.distortion), x)
    away = world_from_cam[:3, 3] - x
    cosine = (away * n).sum(1) / np.linalg.norm(away, axis=1)
    seen = cosines > 0
    assert seen.sum() > 300 and not seen[cosine < detail_kernels.MIN_COSINE - 1e-6].any()
    assert np.allclose(cosines[seen], cosine[seen], atol=1e-5)
    assert np.abs(10 * out[seen, :2] * PIXELS - uv[seen]).max() < 0.02  # the square root's 16 bits
    assert seen[cosine > 0.5].all()


def test_depth_inside_the_mask_is_that_of_all_rays(scene: Scene) -> None:
    """Rays outside of the mask are not cast: the depths, and the edges that are left out, stay the same."""
    view, occluder = FittedPhoto(CAMERAS[0], None), Occluder(scene.mesh)
    alpha = np.zeros((PIXELS, PIXELS), np.float32)
    whole = detail_views._depth(view, np.ones_like(alpha), occluder)
    assert (whole > 0).any()
    alpha[: PIXELS // 2 + 3, PIXELS // 2 - 5 :] = 1
    found = detail_views._depth(view, alpha, occluder)
    inside = cv2.erode(alpha, np.ones((3, 3), np.uint8)) > detail_views.MIN_ALPHA
    np.testing.assert_array_equal(found, np.where(inside, whole, 0))
    assert not detail_views._depth(view, np.zeros_like(alpha), occluder).any()


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_codes_of_levels_are_those_of_pixels(channels: int) -> None:
    """8-bit photos are coded level by level; a photo of the same values in 16 bits pixel by pixel."""
    stored = np.random.default_rng(1).integers(3, 240, (20, 30, channels)).astype(np.uint8)
    codes, peak, shape = detail_views._coded_photo(stored, 1)
    wanted, other, again = detail_views._coded_photo(stored.astype(np.uint16) * 257, 1)
    assert shape == again == (20, 30, 3) and peak == pytest.approx(other, rel=1e-6)
    assert np.abs(codes.astype(int) - wanted).max() <= 1 and codes.max() == 65535
    linear = linear_of(stored)
    np.testing.assert_array_equal(codes, detail_views._coded(linear, float(linear.max())).reshape(-1, 3))
    assert not detail_views._coded_photo(np.zeros_like(stored), 1)[0].any()


def test_smoother_keeps_constants_and_has_its_width(scene: Scene) -> None:
    """On a ball the harmonic of degree 1 falls by 1 / (1 + s^2 / 4 * 2 / R^2) in each of the two steps."""
    width = 0.02
    flow = smoothing.Smoother(scene.mesh, width)
    one = np.ones((len(scene.mesh.vertices), 1))
    assert np.allclose(flow(one), 1, atol=1e-9)
    y = scene.mesh.vertices[:, 1:2].astype(np.float64)
    expected = y / (1 + width**2 / 4 * 2 / RADIUS**2) ** 2
    assert np.abs(flow(y) - expected).max() < 0.01 * RADIUS
    half = (y[:, 0] > 0).astype(np.float64)
    assert np.allclose(flow.mean(3 * one, half)[half > 0], 3, atol=1e-6)


def test_continuation_is_harmonic(scene: Scene) -> None:
    """Known above 60 degrees and below -60: between them u is linear in Mercator's log tan(45 deg + latitude / 2)."""
    v = scene.mesh.vertices.astype(np.float64)
    latitude = np.arcsin((v[:, 1] / RADIUS).clip(-1, 1))
    known = np.abs(latitude) > np.radians(60)
    ordinate = np.log(np.tan(np.pi / 4 + latitude.clip(-1.5, 1.5) / 2))
    limit = np.log(np.tan(np.radians(75)))
    expected = (ordinate / limit).clip(-1, 1)
    got = smoothing.continued(scene.mesh, expected[:, None], known)[:, 0]
    assert np.abs(got - expected).max() < 0.1


def test_shade_is_the_radiance_of_a_white_surface() -> None:
    light = np.zeros((121, 3), np.float32)
    light[0] = np.sqrt(4 * np.pi) * np.float32([1, 2, 3])
    n = np.eye(3)
    assert np.allclose(detail.shade(light, n, np.ones((3, 3), np.float32)), [1, 2, 3], rtol=1e-4)
    dark = detail.shade(light, n, np.full((3, 3), 1e-6, np.float32))
    assert np.allclose(dark, detail.MIN_LIGHT * 2, rtol=1e-4)


def test_clipped_pixels_have_no_say(scene: Scene, tmp_path: Path) -> None:
    """One clipped pixel takes its whole block, and with it every colour that is mixed from the block."""
    c = CAMERAS[0]
    clipped = np.zeros((PIXELS, PIXELS))
    clipped[:, 81] = 1  # the second column of the block of columns 80 and 81
    write_png(tmp_path / "clipped.png", clipped)
    write_exr(tmp_path / "0.exr", np.full((PIXELS, PIXELS, 3), 0.3, np.float32))
    n = scene.mesh.vertices.astype(np.float64) / RADIUS
    x, zero = RADIUS * n, np.zeros((len(n), 3), np.int32)
    plain, burnt = (
        FittedPhoto(c, None, tmp_path / "0.exr"),
        FittedPhoto(c, None, tmp_path / "0.exr", tmp_path / "clipped.png"),
    )
    seen, texel = [], 2.5 * 0.2 / FOCAL
    for view in (plain, burnt):
        photos = detail_views.read_photos([view], np.eye(3)[None], scene.mesh, texel, lambda *_: None)
        assert photos.cameras[0, 18] == PIXELS / 2
        assert (photos.clipped.sum() == PIXELS / 2) if view is burnt else not len(photos.clipped)
        nothing, cosines = np.zeros((len(x), 3), np.float32), np.zeros(len(x), np.float32)
        detail_kernels.residual(
            photos.cameras, 0, photos.pixels, photos.depth, photos.clipped, x, n, zero, nothing, nothing[:1], nothing,
            np.ones_like(nothing), np.zeros_like(nothing), cosines,
        )  # fmt: skip
        empty = np.zeros((1, len(x), 3), np.float32)
        found = detail.Detail(photos, empty, empty, np.zeros((0, 0, 3), np.float32))
        given = detail.Points(x, n, zero, nothing, nothing, np.ones_like(nothing))
        support = found.added(replace(given, albedo=np.full_like(nothing, 0.3)))[1]
        assert np.array_equal(support > 0, cosines > 0)
        seen.append(cosines > 0)
    column = project(matrix(c.K), inverse_rigid(matrix(c.world_from_cam)), np.array(c.distortion), x)[0][:, 0] / 2
    near = (column > 39.5) & (column < 41.5)  # within half a block of the clipped one, whose middle is at 40.5
    assert (near & seen[0]).sum() > 5 and np.array_equal(seen[1], seen[0] & ~near)
