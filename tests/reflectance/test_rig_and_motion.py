"""Where lamps and cameras are for a head that moves, and how its motion is found."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.capture_artifacts import StageLight
from pipeline.errors import StageError
from pipeline.maths.rigid_motion import motion_matrix
from pipeline.transforms import apply, rigid, rows
from stages.reflectance import motion
from stages.reflectance.rig import rig_of
from tests.support.light_stage import DISTANCE, RADIUS, SIZE, K, make_stage
from tests.support.textured_ball import photograph


def cameras_of(poses) -> tuple[Camera, ...]:
    return tuple(
        Camera(index=i, name=str(i), width=SIZE, height=SIZE, K=rows(K), world_from_cam=rows(p), distortion=(0,) * 5)
        for i, p in enumerate(poses)
    )


def lights_of(stage) -> list[StageLight]:
    return [StageLight(index=n, position=tuple(p), axis=tuple(-p / DISTANCE), intensity=tuple(i), frame=n + 1)
            for n, (p, i) in enumerate(zip(stage.positions, stage.intensities, strict=True))]  # fmt: skip


def test_the_head_at_rest_sees_lamps_and_cameras_moved_back() -> None:
    """Oracle: distances and angles between the moved head's points and the unmoved lamp and camera."""
    stage = make_stage(2, 9)
    move = motion_matrix(np.array([0.02, -0.01, 0.03, 1e-3, 2e-3, -1e-3]), np.array([0.01, 0, 0]))
    rig = rig_of(lights_of(stage), cameras_of(stage.poses), np.eye(4), {n: move for n in range(1, 10)})
    points = np.random.default_rng(0).normal(size=(5, 3)) * 0.05
    lamps, axes = rig.lamps()
    moved = apply(move, points)
    for i in range(9):
        np.testing.assert_allclose(np.linalg.norm(lamps[i] - points, axis=1),
                                   np.linalg.norm(stage.positions[i] - moved, axis=1))  # fmt: skip
        np.testing.assert_allclose(
            (points - lamps[i]) @ axes[i], (moved - stage.positions[i]) @ rig.axis[i], atol=1e-12
        )
    eyes = rig.eyes()
    for c, pose in enumerate(stage.poses):
        np.testing.assert_allclose(
            np.linalg.norm(eyes[c, 3] - points, axis=1), np.linalg.norm(pose[:3, 3] - moved, axis=1)
        )
        local = (moved - pose[:3, 3]) @ pose[:3, :3]
        uv, depth = rig.pixels(c, 3, points)
        np.testing.assert_allclose(uv, (local / local[:, 2:]) @ K[:2].T, atol=1e-9)
        np.testing.assert_allclose(depth, local[:, 2])


def test_the_unit_of_the_world_does_not_change_the_light() -> None:
    """Oracle: intensity over squared distance is the same number in metres and in asset units."""
    stage = make_stage(2, 9)
    scaled = np.diag([2.5, 2.5, 2.5, 1.0])
    rig = rig_of(lights_of(stage), (), scaled, {})
    here = (rig.position**2).sum(1)
    np.testing.assert_allclose(rig.strength / here[:, None], stage.intensities / DISTANCE**2)


def test_a_known_motion_is_found_in_pictures() -> None:
    """Oracle: a ball with solid noise, photographed by cameras that moved the other way."""
    stage = make_stage(5, 9)
    cameras = cameras_of(stage.poses)
    true = np.array([0.004, -0.003, 0.005, 6e-4, -8e-4, 5e-4])
    move = motion_matrix(true, np.zeros(3))
    before = [motion.prepared(photograph(p, K, (SIZE, SIZE), RADIUS) / np.float32(255), 1.0) for p in stage.poses]
    after = [motion.prepared(photograph(np.linalg.inv(move) @ p, K, (SIZE, SIZE), RADIUS) / np.float32(255), 1.0)
             for p in stage.poses]  # fmt: skip
    sphere = np.random.default_rng(1).normal(size=(6000, 3))
    sphere *= RADIUS / np.linalg.norm(sphere, axis=1, keepdims=True)
    seen = [sphere[((p[:3, 3] - sphere) * sphere).sum(1) > 0.4 * RADIUS] for p in stage.poses]
    found = motion.pose_between(seen, cameras, before, after, np.zeros(3))
    assert np.linalg.norm(found[3:] - true[3:]) < 1.5e-4
    assert np.degrees(np.linalg.norm(found[:3] - true[:3])) < 0.06
    still = motion.pose_between(seen, cameras, before, before, np.zeros(3))
    assert np.abs(still).max() < 1e-12
    flat = [np.ones_like(b) for b in before]
    assert not motion.pose_between(seen, cameras, flat, flat, np.zeros(3)).any()


def test_the_path_meets_the_poses_and_stays_at_the_ends() -> None:
    rng = np.random.default_rng(3)
    poses = {f: rng.normal(size=6) for f in (0, 17, 34, 51)}
    path = motion.path(poses, [-5, 0, 17, 25, 34, 51, 60])
    for f in poses:
        np.testing.assert_allclose(path[f], poses[f])
    np.testing.assert_allclose(path[-5], poses[0])
    np.testing.assert_allclose(path[60], poses[51])
    cubic = {f: np.full(6, (f / 17.0) ** 3) for f in (0, 17, 34, 51)}  # a cubic spline meets a cubic
    np.testing.assert_allclose(motion.path(cubic, [25])[25], (25 / 17.0) ** 3)
    np.testing.assert_allclose(motion.path({3: np.ones(6)}, [9])[9], 1)
    np.testing.assert_allclose(motion.path({0: np.zeros(6), 10: np.ones(6)}, [5])[5], 0.5)


def test_a_head_that_moved_by_two_centimetres_is_named() -> None:
    with pytest.raises(StageError, match="moved too far") as caught:
        motion.checked({0: np.zeros(6), 17: np.array([0, 0, 0, 0.021, 0, 0])})
    assert "frame 17" in str(caught.value) and "21 mm" in str(caught.value)
    motion.checked({0: np.array([0, 0, 0, 0.0199, 0, 0])})


def test_motion_is_a_rotation_about_the_pivot_and_a_shift() -> None:
    """Oracle: Rodrigues' formula for a quarter turn about y."""
    m = motion_matrix(np.array([0, np.pi / 2, 0, 0.1, 0, 0]), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(apply(m, np.array([[1.0, 0, 0], [1, 0, 1]])), [[1.1, 0, 0], [2.1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(motion_matrix(np.zeros(6), np.ones(3)), rigid(np.eye(3), np.zeros(3)))
