"""Matches along epipolar lines, and the solution made from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.transforms import inverse_rigid, project
from stages.poses.features import Features
from stages.poses.guided import fundamental, guided, guided_pairs, near_pairs, straight
from stages.poses.mapper import Pose
from stages.poses.matching import match
from stages.poses.rematch import colmap_camera, reconstructed
from tests.support.posed_points import BENT, SIZE, STRAIGHT, K, apart, moved, pose_at, world


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_pixels_of_a_point_meet_the_fundamental_matrix(scale: float) -> None:
    """Oracle: projection. Lenses differ, the world's unit is any."""
    a, b = pose_at(10.0, STRAIGHT), pose_at(38.0, STRAIGHT, np.diag([900.0, 950.0, 1.0]) + np.eye(3, k=2) * 300)
    for pose in (a, b):
        pose.world_from_cam[:3, 3] *= scale
    x = np.random.default_rng(0).normal(size=(50, 3)) * 0.1 * scale
    seen = [np.c_[project(p.K, inverse_rigid(p.world_from_cam), np.zeros(5), x)[0], np.ones(50)] for p in (a, b)]
    F = fundamental(a, b)
    assert np.linalg.norm(F) == pytest.approx(1)
    line = seen[0] @ F.T
    off = np.abs((line * seen[1]).sum(1)) / np.hypot(line[:, 0], line[:, 1])
    assert off.max() < 1e-6
    assert np.abs(np.linalg.svd(F)[1][2]) < 1e-12


def test_two_photos_from_one_place_have_no_epipolar_lines() -> None:
    a = pose_at(10.0)
    with pytest.raises(ValueError, match="same camera centre"):
        fundamental(a, a)
    own = world([10.0, 10.0])
    poses = dict(enumerate(own.poses))
    assert guided_pairs(poses, own.photos(), own.features, [(0, 1)], lambda: None) == {}


def test_features_are_moved_to_where_a_lens_without_distortion_shows_them() -> None:
    own, ideal = world([20.0], noise=0.0, others=0), world([20.0], noise=0.0, others=0, lens=STRAIGHT)
    assert np.abs(own.features[0].uv - ideal.features[0].uv).max() > 0.15
    np.testing.assert_allclose(straight(own.features[0], own.poses[0]).uv, ideal.features[0].uv, atol=2e-3)


def test_points_that_look_alike_are_told_apart_by_the_lines() -> None:
    """Every descriptor occurs ten times: the ratio test rejects all matches of the whole photo."""
    own = world([0.0, 15.0], kinds=40, lens=STRAIGHT)
    a, b = own.features
    assert len(match(a.descriptors, b.descriptors, 0.8)) < 10
    found = guided(a, b, fundamental(*own.poses), 1.25)
    right = found[:, 0] == found[:, 1]  # all points are shown, in the same order
    assert right.sum() > 150 and right.mean() > 0.9


def test_only_features_near_the_line_match_in_both_photos() -> None:
    own = world([0.0, 15.0], lens=STRAIGHT, others=0)
    a, b = own.features
    F = fundamental(*own.poses)
    assert len(guided(a, b, F, 1.25)) > 350
    line = np.c_[a.uv, np.ones(len(a.uv))] @ F.T
    away = line[:, :2] / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    off = Features((b.uv + 4 * away).astype(np.float32), b.descriptors)
    assert len(guided(a, off, F, 1.25)) < 20 < 350 < len(guided(a, off, F, 6.0))
    nothing = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    assert guided(a, nothing, F, 1.25).shape == guided(nothing, b, F, 1.25).shape == (0, 2)


def test_a_pixel_off_the_line_is_four_in_a_photo_zoomed_in() -> None:
    own = world([0.0, 15.0], lens=STRAIGHT, others=0, noise=0.0)
    zoom = np.diag([4.0, 4.0, 1.0])
    a, b = Features(own.features[0].uv * 4, own.features[0].descriptors), own.features[1]
    F = fundamental(Pose(zoom @ K, own.poses[0].world_from_cam, STRAIGHT), own.poses[1])
    assert len(guided(a, b, F, 1.25)) > 350
    line = np.c_[a.uv, np.ones(len(a.uv))] @ F.T
    away = line[:, :2] / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    off = Features((b.uv + away).astype(np.float32), b.descriptors)
    assert len(guided(a, off, F, 1.25)) == len(guided(off, a, F.T, 1.25)) < 20 < 350 < len(guided(a, off, F, 5.0))


def test_pairs_are_those_nearest_in_direction() -> None:
    poses = {i: pose_at(float(d)) for i, d in ((3, 0), (5, 10), (7, 30), (9, 90))}
    assert near_pairs(poses, partners=1) == [(3, 5), (5, 7)]  # 9 has no partner within 40 degrees
    assert near_pairs(poses) == [(3, 5), (3, 7), (5, 7)]


def test_pairs_of_photos_are_matched_and_weak_ones_left_out() -> None:
    own = world([0.0, 12.0, 24.0])
    own.features[2] = Features(own.features[2].uv[-300:], own.features[2].descriptors[-300:])  # it shows nothing
    calls: list[int] = []
    found = guided_pairs(dict(enumerate(own.poses)), own.photos(), own.features, [(0, 1), (1, 2)],
                         lambda: calls.append(1))  # fmt: skip
    assert list(found) == [(0, 1)] and len(calls) == 2 and len(found[0, 1].matches) > 300

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        guided_pairs(dict(enumerate(own.poses)), own.photos(), own.features, [(0, 1)], stop)


def test_cameras_that_are_off_come_back(tmp_path: Path) -> None:
    """Poses turned by up to a degree, and a focal length 2 % off: what the matches say is 20 times as near."""
    own = world([0.0, 12.0, 24.0, 36.0, 48.0, 60.0], share=0.9)
    off = {i: moved(p, 0.6 * (-1) ** i) for i, p in enumerate(own.poses)}
    longer = np.array([[1224.0, 0, 320], [0, 1224, 428], [0, 0, 1]])
    off = {i: Pose(longer, p.world_from_cam, p.distortion) for i, p in off.items()}
    pairs = near_pairs(dict(enumerate(own.poses)))
    matches = guided_pairs(dict(enumerate(own.poses)), own.photos(), own.features, pairs, lambda: None)
    found = reconstructed(own.model(list(range(6)), off), own.photos(), own.features, matches, "SIMPLE_RADIAL",
                          tmp_path / "a", 0)  # fmt: skip
    assert found is not None and not (tmp_path / "a").exists() and len({p.K[0, 0] for p in found.poses.values()}) == 1
    assert found.reprojection_error_px < 0.5 and len(found.points) > 380
    turns = [apart(found.poses[i], found.poses[i + 1])[1] - apart(own.poses[i], own.poses[i + 1])[1] for i in range(5)]
    assert np.abs(turns).max() < 0.06  # degrees; they were 1.2 off
    assert found.poses[0].K[0, 0] == pytest.approx(1200, rel=0.005)
    assert reconstructed(own.model(list(range(6)), off), own.photos(), own.features, {}, "SIMPLE_RADIAL",
                         tmp_path / "b", 0) is None  # fmt: skip


def test_colmaps_cameras_have_the_same_lens() -> None:
    pose = Pose(np.array([[900.0, 0, 300], [0, 950, 400], [0, 0, 1]]), np.eye(4), (0.1, -0.02, 0.001, 0.002, 0.0))
    opencv = colmap_camera(pose, *SIZE, "OPENCV")
    assert list(opencv.params) == [900, 950, 300, 400, 0.1, -0.02, 0.001, 0.002]
    simple = colmap_camera(Pose(K, np.eye(4), BENT), *SIZE, "SIMPLE_RADIAL")
    assert list(simple.params) == [1200, 320, 428, 0.05] and (simple.width, simple.height) == SIZE
