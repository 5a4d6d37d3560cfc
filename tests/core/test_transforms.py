"""Cameras against OpenCV, frames against their own definitions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import transforms as t

LENSES = {
    "none": np.zeros(5),
    "phone": np.array([0.05, -0.12, 0.001, -0.0008, 0.04]),
    "strong barrel": np.array([-0.32, 0.12, 0.002, -0.003, -0.02]),
    "strong pincushion": np.array([0.25, 0.1, -0.004, 0.003, 0.05]),
    "tangential": np.array([0.0, 0.0, 0.02, -0.015, 0.0]),
}
K = np.array([[900.0, 0.0, 322.5], [0.0, 880.0, 243.0], [0.0, 0.0, 1.0]])


def pose(seed: int) -> np.ndarray:
    r = np.random.default_rng(seed)
    rotation = cv2.Rodrigues(r.normal(size=3))[0]
    return t.rigid(rotation, r.normal(size=3))


def in_front(cam_from_world: np.ndarray, n: int = 500, spread: float = 0.45) -> np.ndarray:
    r = np.random.default_rng(9)
    z = r.uniform(0.5, 3, n)
    points = np.stack([r.uniform(-spread, spread, n) * z, r.uniform(-spread, spread, n) * z, z], -1)
    return t.apply(t.inverse_rigid(cam_from_world), points)


@pytest.mark.parametrize("lens", LENSES)
def test_project_as_opencv_does(lens: str) -> None:
    world = pose(1)
    points = in_front(world)
    uv, depth = t.project(K, world, LENSES[lens], points)
    # OpenCV has the first pixel's centre at 0, we at 0.5
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(world[:3, :3])[0], world[:3, 3], t.centre_K_from_corner_K(K),
                                    LENSES[lens])  # fmt: skip
    assert np.abs(uv - 0.5 - expected[:, 0]).max() < 1e-9
    assert np.allclose(depth, t.apply(world, points)[:, 2])


@pytest.mark.parametrize("lens", LENSES)
def test_undistort_is_the_exact_inverse(lens: str) -> None:
    r = np.random.default_rng(2)
    xy = r.uniform(-0.6, 0.6, (2000, 2))
    assert np.abs(t.undistort(t.distort(xy, LENSES[lens]), LENSES[lens]) - xy).max() < 1e-10
    assert np.abs(t.distort(t.undistort(xy * 0.9, LENSES[lens]), LENSES[lens]) - xy * 0.9).max() < 1e-10


def test_undistort_agrees_with_opencv() -> None:
    xy = np.random.default_rng(3).uniform(-0.5, 0.5, (300, 2))
    lens = LENSES["strong barrel"]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    expected = cv2.undistortPoints(xy[:, None], np.eye(3), lens, criteria=criteria)[:, 0]
    assert np.abs(t.undistort(xy, lens) - expected).max() < 1e-8


def test_undistort_of_nothing_and_of_the_centre() -> None:
    lens = LENSES["strong barrel"]
    assert t.undistort(np.empty((0, 2)), lens).shape == (0, 2)
    assert np.allclose(t.undistort(np.zeros((1, 2)), lens), 0, atol=1e-15)


@pytest.mark.parametrize("lens", LENSES)
def test_rays_go_through_what_projects_there(lens: str) -> None:
    world = pose(4)
    points = in_front(world)
    uv, _ = t.project(K, world, LENSES[lens], points)
    origin, directions = t.rays(K, t.inverse_rigid(world), LENSES[lens], uv)
    along = points - origin
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    assert np.abs(np.cross(directions, along)).max() < 1e-9
    assert ((directions * along).sum(1) > 0).all()
    assert np.allclose(t.apply(world, origin[None]), 0)


def test_behind_the_camera_is_nan() -> None:
    uv, depth = t.project(K, np.eye(4), LENSES["phone"], np.array([[0, 0, -1.0], [0, 0, 0.0], [0, 0, 1.0]]))
    assert np.isnan(uv[:2]).all() and np.isfinite(uv[2]).all()
    assert depth.tolist() == [-1, 0, 1]


def test_skew_is_honoured() -> None:
    skewed = K.copy()
    skewed[0, 1] = 30.0
    points = in_front(np.eye(4))
    uv, _ = t.project(skewed, np.eye(4), np.zeros(5), points)
    expected = points @ skewed.T
    assert np.allclose(uv, expected[:, :2] / expected[:, 2:])
    _, directions = t.rays(skewed, np.eye(4), np.zeros(5), uv)
    assert np.allclose(directions, points / np.linalg.norm(points, axis=1, keepdims=True))


def test_half_a_pixel() -> None:
    assert t.corner_K_from_centre_K(K)[:2, 2].tolist() == [323.0, 243.5]
    assert np.array_equal(t.centre_K_from_corner_K(t.corner_K_from_centre_K(K)), K)
    assert K[0, 2] == 322.5  # the argument is left alone
    assert t.pixel_centres(2, 2).tolist() == [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]]
    assert t.pixel_centres(5, 4, 2).tolist() == [[1, 1], [3, 1], [1, 3], [3, 3]]


def test_inverse_rigid() -> None:
    m = pose(5)
    assert np.allclose(t.inverse_rigid(m) @ m, np.eye(4))
    assert np.allclose(t.inverse_rigid(m), np.linalg.inv(m))


def test_a_camera_sees_the_same_before_and_after_its_world_is_scaled() -> None:
    """Image positions do not depend on the world's units; depth does, by the scale."""
    world_from_cam = t.inverse_rigid(pose(6))
    new_from_old = t.similarity(0.01, pose(7)[:3, :3], np.array([3.0, -2.0, 5.0]))
    points = in_front(pose(6))
    before, z = t.project(K, t.inverse_rigid(world_from_cam), LENSES["phone"], points)
    moved = t.rescale_camera(new_from_old, world_from_cam)
    after, scaled = t.project(K, t.inverse_rigid(moved), LENSES["phone"], t.apply(new_from_old, points))
    assert np.allclose(before, after, atol=1e-7)
    assert np.allclose(scaled, 0.01 * z)
    assert np.allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3))


def test_usd_cameras_look_along_minus_z_with_y_up() -> None:
    forward, down = np.array([0, 0, 1.0, 1]), np.array([0, 1.0, 0, 1])
    assert (t.USD_CAM_FROM_OPENCV_CAM @ forward)[2] == -1
    assert (t.USD_CAM_FROM_OPENCV_CAM @ down)[1] == -1
    assert np.linalg.det(t.USD_CAM_FROM_OPENCV_CAM[:3, :3]) == 1  # a rotation, no mirror


def test_manifest_rows_round_trip_exactly() -> None:
    m = pose(8)
    assert np.array_equal(t.matrix(t.rows(m)), m)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_nearest_similarity_is_found_and_never_mirrors(mirrored: bool) -> None:
    """Exact where there is one; for points that are each other's mirror image still a turn, the best of 5,000 others.
    Of one point it has scale 0 and hits the middle."""
    random = np.random.default_rng(0)
    source = random.normal(size=(30, 3)) * [3, 2, 1]
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    place = t.similarity(2.5, turn, np.array([1.0, -2, 3]))
    target = t.apply(place, source * [1, 1, -1] if mirrored else source)
    found = t.umeyama(source, target)
    assert np.linalg.det(found[:3, :3]) > 0
    if not mirrored:
        assert np.allclose(found, place)

    def off(scale: float, rotation: np.ndarray) -> float:
        moved = scale * (source - source.mean(0)) @ rotation.T
        return float(((moved - (target - target.mean(0))) ** 2).sum())

    scale = float(np.cbrt(np.linalg.det(found[:3, :3])))
    best = off(scale, found[:3, :3] / scale)
    for r in Rotation.random(5000, random_state=0).as_matrix():
        assert best <= off(scale, r) + 1e-9
    assert best <= min(off(0.98 * scale, found[:3, :3] / scale), off(1.02 * scale, found[:3, :3] / scale))
    point = t.umeyama(np.ones((4, 3)), target[:4])
    assert np.allclose(point[:3, :3], 0) and np.allclose(point[:3, 3], target[:4].mean(0))
