"""Rigid motions as six numbers, and what they move in a picture, against OpenCV's projection and finite differences."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.linalg import expm

from pipeline.maths import rigid_motion as motion
from pipeline.transforms import F64, apply, inverse_rigid, project, projection_slope, rigid

K = np.array([[900.0, 0.0, 320.0], [0.0, 700.0, 250.0], [0.0, 0.0, 1.0]])
LENS = np.array([0.12, -0.05, 0.002, -0.003, 0.01])
POINTS = np.random.default_rng(3).uniform(-0.1, 0.1, (40, 3))
SIX = np.array([0.02, -0.05, 0.03, 0.004, -0.002, 0.006])
PIVOT = np.array([0.01, -0.03, 0.02])


def camera() -> F64:
    """4x4 cam_from_world, half a metre away."""
    turn = np.asarray(cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0], np.float64)
    return rigid(turn, np.array([0.01, -0.02, 0.5]))


def by_opencv(points: F64, lens: F64 = LENS) -> F64:
    """(N, 2) pixels, by code that this project does not share."""
    cam = camera()
    uv, _ = cv2.projectPoints(points, cv2.Rodrigues(cam[:3, :3])[0], cam[:3, 3], K, lens)
    return np.asarray(uv[:, 0], np.float64)


def of_lie_algebra(six: F64, pivot: F64) -> F64:
    """4x4 by the matrix exponential of the rotation."""
    x, y, z = six[:3]
    turn = expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    return rigid(turn, pivot + six[3:] - turn @ pivot)


def differences(moved: object, h: float = 1e-6) -> F64:
    """(N, 2, 6) central differences of a function of six numbers."""
    steps = [(moved(h * e) - moved(-h * e)) / (2 * h) for e in np.eye(6)]  # type: ignore[operator]
    return np.stack(steps, -1)


@pytest.mark.parametrize("lens", [LENS, np.zeros(5)])
def test_the_slope_of_the_projection_is_that_of_opencv(lens: F64) -> None:
    np.testing.assert_allclose(project(K, camera(), lens, POINTS)[0], by_opencv(POINTS, lens), atol=1e-6)
    h, found = 1e-6, projection_slope(K, camera(), lens, POINTS)
    for axis, e in enumerate(np.eye(3)):
        wanted = (by_opencv(POINTS + h * e, lens) - by_opencv(POINTS - h * e, lens)) / (2 * h)
        np.testing.assert_allclose(found[..., axis], wanted, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("pivot", [motion.ORIGIN, PIVOT])
def test_the_slope_by_a_motion_is_that_of_finite_differences(pivot: F64) -> None:
    found = motion.motion_slope(POINTS, projection_slope(K, camera(), LENS, POINTS), pivot)
    wanted = differences(lambda six: by_opencv(apply(of_lie_algebra(six, pivot), POINTS)))
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=2e-3)


def test_six_numbers_are_the_motion_of_the_matrix_exponential() -> None:
    for six in (SIX, np.zeros(6), 1e-9 * SIX, np.array([0, 3.1, 0, 0.1, 0, 0])):
        matrix = motion.motion_matrix(six, PIVOT)
        np.testing.assert_allclose(matrix, of_lie_algebra(six, PIVOT), atol=1e-12)
        np.testing.assert_allclose(motion.six_of(matrix, PIVOT), six, atol=1e-9)


def test_one_motion_after_another_is_the_product() -> None:
    second = np.array([-0.4, 0.2, 0.1, 0.01, 0.03, -0.02])
    both = motion.motion_matrix(motion.after(second, SIX), PIVOT)
    np.testing.assert_allclose(both, motion.motion_matrix(second, PIVOT) @ motion.motion_matrix(SIX, PIVOT), atol=1e-12)


def test_a_camera_that_moves_instead_of_the_head_sees_the_same() -> None:
    pose = inverse_rigid(camera())
    moved = motion.camera_of_moved(pose, SIX)
    seen = project(K, camera(), LENS, apply(motion.motion_matrix(SIX), POINTS))[0]
    np.testing.assert_allclose(project(K, inverse_rigid(moved), LENS, POINTS)[0], seen, atol=1e-9)
    np.testing.assert_allclose(motion.motion_between(pose, moved), SIX, atol=1e-12)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)


def test_no_points_have_no_slopes() -> None:
    none = np.zeros((0, 3))
    assert motion.motion_slope(none, projection_slope(K, camera(), LENS, none)).shape == (0, 2, 6)
