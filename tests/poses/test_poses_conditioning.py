"""Standard deviations of principal points: against the whole normal matrix, and where nothing tells them."""

from __future__ import annotations

import numpy as np
from scipy.optimize._numdiff import approx_derivative
from scipy.spatial.transform import Rotation

from pipeline.transforms import F64, inverse_rigid, project, rigid
from stages.poses.conditioning import Observations, principal_point_deviation, project_all
from tests.support.textured_ball import camera_on_orbit

K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])


def scene(poses: list[F64], points: int, seed: int = 0) -> tuple[F64, F64, Observations]:
    random = np.random.default_rng(seed)
    x = random.normal(scale=0.08, size=(points, 3))
    cams = np.stack([inverse_rigid(p)[:3] for p in poses])
    photo, point = np.repeat(np.arange(len(poses)), points), np.tile(np.arange(points), len(poses))
    lens = np.tile([700.0, 320, 240, 0], (len(photo), 1))
    uv = project_all(lens, np.ones(len(photo)), cams[photo], x[point])
    return cams, x, Observations(photo, point, uv, np.zeros(len(poses), np.int64))


def all_around() -> list[F64]:
    roll = [rigid(Rotation.from_euler("z", 70.0 * i, degrees=True).as_matrix(), np.zeros(3)) for i in range(6)]
    return [camera_on_orbit(60 * i, 20 * (i % 3) - 20, 0.6, np.zeros(3)) @ roll[i] for i in range(6)]


def test_projection_is_that_of_the_cameras() -> None:
    cams, x, seen = scene(all_around(), 7)
    for cam in cams:
        uv, _ = project(K, rigid(cam[:, :3], cam[:, 3]), np.array([0.1, 0, 0, 0, 0]), x)
        lens = np.tile([700.0, 320, 240, 0.1], (7, 1))
        np.testing.assert_allclose(project_all(lens, np.ones(7), np.tile(cam, (7, 1, 1)), x), uv, atol=1e-9)
    assert len(seen.uv) == 42


def test_deviation_is_that_of_the_whole_normal_matrix() -> None:
    cams, x, seen = scene(all_around(), 12)
    n = len(cams)
    noise = np.random.default_rng(1).normal(scale=0.5, size=seen.uv.shape)

    def uv_of(p: F64) -> F64:
        """Every unknown moved at once; turns by scipy's rotation vectors."""
        turn = Rotation.from_rotvec(p[4 : 4 + 3 * n].reshape(n, 3)).as_matrix()
        shift = p[4 + 3 * n : 4 + 6 * n].reshape(n, 3, 1)
        moved = np.concatenate([turn @ cams[:, :, :3], turn @ cams[:, :, 3:] + shift], 2)
        lens = np.tile(np.array([700.0, 320, 240, 0]) + p[:4], (len(seen.photo), 1))
        points = x + p[4 + 6 * n :].reshape(-1, 3)
        return project_all(lens, np.ones(len(seen.photo)), moved[seen.photo], points[seen.point]).ravel()

    J = approx_derivative(uv_of, np.zeros(4 + 6 * n + x.size), method="3-point")
    variance = (noise**2).sum() / (noise.size - J.shape[1] + 7)
    value, vector = np.linalg.eigh(J.T @ J)
    kept = vector[1:3, 7:]  # the seven smallest are the world's own freedoms
    expected = np.sqrt(variance * (kept**2 / value[7:]).sum(1))
    noisy = Observations(seen.photo, seen.point, seen.uv + noise, seen.lens_of)
    said = principal_point_deviation(np.tile(K, (n, 1, 1)), np.zeros(n), cams, x, noisy)[0]
    np.testing.assert_allclose(said, expected, rtol=0.02)


def test_a_narrow_arc_of_level_cameras_does_not_tell_it() -> None:
    near = [camera_on_orbit(2.0 * i, 0, 0.6, np.zeros(3)) for i in range(6)]
    said = []
    for poses in (all_around(), near):
        cams, x, seen = scene(poses, 60)
        noise = np.random.default_rng(2).normal(scale=0.5, size=seen.uv.shape)
        noisy = Observations(seen.photo, seen.point, seen.uv + noise, seen.lens_of)
        said.append(principal_point_deviation(np.tile(K, (6, 1, 1)), np.zeros(6), cams, x, noisy).max())
    assert said[1] > 10 * said[0]
