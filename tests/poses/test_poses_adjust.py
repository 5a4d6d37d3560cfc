"""Bundle adjustment against known cameras: wrong matches have no say, given cameras are mended, all mappers agree."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.transforms import F64, inverse_rigid, matrix, project, rigid, rows
from stages.poses.bundle_adjustment import Refine, adjust, adjust_near
from stages.poses.features import Features
from stages.poses.mapper import Lens, reconstruct
from stages.poses.matching import Verified, promising_pairs
from stages.poses.sfm import GLOBAL_FROM, mappers
from stages.poses.triangulate import triangulate
from tests.support.textured_ball import camera_on_orbit, write_facescape

SIZE = (320, 280)
K = np.array([[700.0, 0, 160.0], [0, 700.0, 140.0], [0, 0, 1]])
ORBIT = [camera_on_orbit(14.0 * i - 42, 12.0 * (i % 2), 0.6, np.zeros(3)) for i in range(7)]


def reconstruction(wrong: float, noise: float, shift: float = 0.0) -> pycolmap.Reconstruction:
    """200 points in the 7 views, `noise` pixels off, a share of `wrong` sightings 4 to 8 pixels off to one side, and
    cameras whose centres start `shift` away from the truth."""
    rng = np.random.default_rng(1)
    found = pycolmap.Reconstruction()
    points = rng.normal(size=(200, 3)) * 0.04
    found.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=320, height=280, params=[700.0, 160, 140, 0])
    )
    for i, pose in enumerate(ORBIT, 1):
        world = inverse_rigid(pose)
        uv = (points @ world[:3, :3].T + world[:3, 3]) @ K.T
        uv = uv[:, :2] / uv[:, 2:] + rng.normal(size=(200, 2)) * noise
        uv[rng.random(200) < wrong] += rng.uniform(4, 8, 2)
        image = pycolmap.Image(name=f"{i}", camera_id=1, image_id=i)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(p) for p in uv])
        moved = rigid(pose[:3, :3], pose[:3, 3] + rng.normal(size=3) * shift)
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse_rigid(moved)[:3]))
    for k, p in enumerate(points):
        track = pycolmap.Track()
        for i in range(1, 8):
            track.add_element(i, k)
        found.add_point3D(p, track)
    return found


def centres(found: pycolmap.Reconstruction) -> F64:
    return np.array([found.images[i].projection_center() for i in range(1, 8)])


def shape_error(found: pycolmap.Reconstruction) -> float:
    """Largest distance from the true centres after the best similarity, of the cameras' distance."""
    truth = np.stack([p[:3, 3] for p in ORBIT])
    moved = pycolmap.estimate_sim3d(centres(found), truth)
    return float(np.linalg.norm(np.array([moved * c for c in centres(found)]) - truth, axis=1).max() / 0.6)


def test_wrong_matches_have_no_say() -> None:
    clean, spoilt = reconstruction(0.0, 0.3), reconstruction(0.08, 0.3)
    for found in (clean, spoilt):
        adjust(found, Refine(), principal_point=False)
    squares = reconstruction(0.08, 0.3)
    pycolmap.bundle_adjustment(squares, pycolmap.BundleAdjustmentOptions(print_summary=False))
    assert shape_error(clean) < 0.004
    assert shape_error(spoilt) < 2 * shape_error(clean) < shape_error(squares)


def test_exact_matches_stay_exact() -> None:
    found = reconstruction(0.0, 0.0)
    adjust(found, Refine(), principal_point=True)
    assert shape_error(found) < 1e-6
    assert found.cameras[1].params == pytest.approx([700, 160, 140, 0], abs=1e-3)


def test_centres_are_held_near_the_given_ones() -> None:
    truth = {i: p[:3, 3] for i, p in enumerate(ORBIT, 1)}
    free, held = (reconstruction(0.0, 0.3, shift=0.005) for _ in range(2))
    adjust_near(held, truth, 1e-5)
    assert np.abs(centres(held) - np.stack(list(truth.values()))).max() < 1e-4
    given = {i: np.array(c) for i, c in enumerate(centres(free), 1)}
    for _ in range(2):  # what the sightings' deviation is shows when the cameras were moved once
        adjust_near(free, given, 0.005)
    before = np.linalg.norm(np.stack(list(given.values())) - np.stack(list(truth.values())), axis=1).mean()
    assert shape_error(free) * 0.6 < 0.5 * before  # the photos say where they are to each other ...
    assert (
        np.linalg.norm((centres(free) - np.stack(list(given.values()))).mean(0)) < 1e-3
    )  # the prior where in the world
    assert free.cameras[1].params == pytest.approx([700, 160, 140, 0], abs=0)


def imperfect(folder: Path) -> Path:
    """The ball with cameras half a percent of their distance and 0.2 degrees off."""
    params = write_facescape(folder, ORBIT, K, SIZE)
    rng = np.random.default_rng(4)
    for i, pose in enumerate(ORBIT):
        turn = cv2.Rodrigues(rng.normal(size=3) * np.radians(0.2))[0]
        off = rigid(pose[:3, :3] @ turn, pose[:3, 3] + rng.normal(size=3) * 0.003)
        params[f"{i}_Rt"] = inverse_rigid(off)[:3].tolist()
    (folder / "params.json").write_text(json.dumps(params))
    return folder


@pytest.mark.slow
def test_given_cameras_are_mended(tmp_path: Path, capture_of, place) -> None:
    capture = capture_of(imperfect(tmp_path / "c"))
    kept, seen, mended = (place(capture, given=g, unit="metres") for g in ("keep", "triangulate", "refine"))
    assert kept.artifact.points is None and seen.artifact.cameras == kept.artifact.cameras
    assert seen.artifact.source == mended.artifact.source == "given"
    assert mended.artifact.reprojection_error_px < 0.6 < seen.artifact.reprojection_error_px
    assert len(mended.artifact.view_errors_px) == 7
    relative, points = [], []
    for located in (kept, mended):
        poses = np.stack([matrix(c.world_from_cam) for c in located.artifact.cameras])
        found = [inverse_rigid(a)[:3, :3] @ b[:3, :3] for a, b in zip(poses, poses[1:], strict=False)]
        true = [inverse_rigid(a)[:3, :3] @ b[:3, :3] for a, b in zip(ORBIT, ORBIT[1:], strict=False)]
        relative.append(np.mean([np.linalg.norm(f - t) for f, t in zip(found, true, strict=True)]))
    assert relative[1] < 0.4 * relative[0]  # what one camera says of the next
    with np.load(mended.path(mended.artifact.points), allow_pickle=False) as f:
        points = f["points"]
    world = matrix(mended.artifact.capture_from_asset)
    radius = np.linalg.norm(points @ world[:3, :3].T + world[:3, 3], axis=1)
    assert len(points) > 100 and np.median(radius) == pytest.approx(0.1, rel=0.03)


def test_triangulation_knows_skew_and_all_five_terms(tmp_path: Path) -> None:
    skewed = K + np.array([[0, 12.0, 0], [0] * 3, [0] * 3])
    d = np.array([-0.2, 0.1, 0.003, -0.002, 0.05])
    points = np.random.default_rng(2).normal(size=(60, 3)) * 0.05
    features, cameras = [], []
    for i, pose in enumerate(ORBIT[:4]):
        uv, _ = project(skewed, inverse_rigid(pose), d, points)
        features.append(Features(uv.astype(np.float32), np.zeros((60, 128), np.float32)))
        cameras.append(Camera(index=i, name=f"{i}.jpg", width=320, height=280, K=rows(skewed), distortion=tuple(d),
                              world_from_cam=rows(pose)))  # fmt: skip
    all_of = np.stack([np.arange(60)] * 2, 1).astype(np.uint32)
    verified = {pair: Verified(np.eye(3), all_of) for pair in ((0, 1), (0, 2), (1, 2))}
    found = triangulate(tmp_path, cameras, features, verified, refine=False, deviation=1.0, seed=0)
    assert found is not None and found[1] == []
    found = found[0]
    assert len(found.points) > 50 and found.reprojection_error_px < 1e-3
    nearest = np.linalg.norm(found.points[:, None] - points, axis=2).min(1)
    assert nearest.max() < 1e-5
    np.testing.assert_allclose(found.poses[1].K, skewed)
    verified[0, 3] = Verified(np.eye(3), all_of[:15])  # the fourth sees hardly anything
    (tmp_path / "again").mkdir()
    found, doubtful = triangulate(tmp_path / "again", cameras, features, verified, refine=True, deviation=1e-3, seed=0)
    assert doubtful == [3]
    np.testing.assert_array_equal(found.poses[3].world_from_cam, ORBIT[3])


def test_photos_that_share_no_point(tmp_path: Path, capture_of, place) -> None:
    write_facescape(tmp_path / "c", ORBIT[:3], K, SIZE, pictures=False)
    with pytest.raises(StageError, match="no point is visible"):
        place(capture_of(tmp_path / "c", drop_blurred=False), given="triangulate", check=False, unit="metres")


def test_all_at_once_is_where_one_by_one_is(tmp_path: Path) -> None:
    orbit = [camera_on_orbit(20.0 * i, 15.0 * (i % 3), 0.6, np.zeros(3)) for i in range(18)]
    rng, wide = np.random.default_rng(3), np.array([[300.0, 0, 160], [0, 300.0, 140], [0, 0, 1]])
    points, features, verified = rng.normal(size=(150, 3)) * 0.06, [], {}
    for pose in orbit:
        uv, _ = project(wide, inverse_rigid(pose), np.zeros(5), points)
        features.append(Features((uv + rng.normal(size=uv.shape) * 0.2).astype(np.float32), np.zeros((150, 128))))
    for i in range(18):
        for j in (i + 1, i + 2, i + 3):
            common = np.sort(rng.choice(150, 80, replace=False))
            F, _ = cv2.findFundamentalMat(features[i].uv[common], features[j % 18].uv[common], cv2.FM_8POINT)
            pair, F = ((i, j), F) if j < 18 else ((j % 18, i), F.T)
            verified[pair] = Verified(F, np.stack([common] * 2, 1).astype(np.uint32))
    off = {}
    for mapper in ("incremental", "global"):
        (tmp_path / mapper).mkdir()
        found = reconstruct(tmp_path / mapper, [Lens(320, 280, 290.0)], [0] * 18, features, verified,
                            camera_model="SIMPLE_RADIAL", mapper=mapper, refine=Refine(), seed=0,
                            next_image=lambda: False)  # fmt: skip
        assert found is not None and len(found.poses) == 18
        at = np.stack([found.poses[i].world_from_cam[:3, 3] for i in range(18)])
        truth = np.stack([p[:3, 3] for p in orbit])
        moved = pycolmap.estimate_sim3d(at, truth)
        off[mapper] = np.linalg.norm(np.array([moved * c for c in at]) - truth, axis=1).max() / 0.6
    assert max(off.values()) < 0.002
    (tmp_path / "stopped").mkdir()
    assert reconstruct(tmp_path / "stopped", [Lens(320, 280)], [0] * 18, features, verified, refine=Refine(), seed=0,
                       camera_model="SIMPLE_RADIAL", mapper="global", next_image=lambda: True) is None  # fmt: skip


def test_the_way_of_placing_goes_by_number() -> None:
    assert mappers(GLOBAL_FROM - 1, "auto") == ("incremental",)
    assert mappers(GLOBAL_FROM, "auto") == ("global", "incremental")
    assert mappers(5, "global") == ("global",)


def test_frames_of_a_film_are_paired_with_the_next_ones() -> None:
    rng = np.random.default_rng(0)
    found = rng.random((24, 8, 128)).astype(np.float32)  # features that say nothing
    found /= np.linalg.norm(found, axis=2, keepdims=True)
    features = [Features(np.zeros((8, 2), np.float32), d) for d in found]
    pairs = promising_pairs(features, 0.8, 8, in_order=True)
    assert {(i, i + k) for i in range(22) for k in (1, 2)} <= set(pairs)
    assert not {(i, i + 1) for i in range(23)} <= set(promising_pairs(features, 0.8, 8))
