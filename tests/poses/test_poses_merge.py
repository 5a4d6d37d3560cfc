"""Reconstructions that share photos: the shared photos tell the similarity, and nothing else does."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pipeline.transforms import F64, inverse_rigid, project
from stages.poses.features import Features
from stages.poses.known_poses import with_points, with_poses
from stages.poses.mapper import write_database
from stages.poses.matching import Verified
from stages.poses.merge import merged, similarity
from tests.support.textured_ball import camera_on_orbit

COUNT, POINTS = 14, 200
K = np.array([[300.0, 0, 160], [0, 300.0, 140], [0, 0, 1]])
ORBIT = [camera_on_orbit(18.0 * i, 15.0 * (i % 3), 0.6, np.zeros(3)) for i in range(COUNT)]
ONTO = pycolmap.Sim3d(
    2.5, pycolmap.Rotation3d(cv2.Rodrigues(np.array([0.3, -1.1, 0.7]))[0]), np.array([1.0, -2.0, 0.5])
)


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """Photos of the same points, each matched with the next three, .2 pixels off."""
    rng = np.random.default_rng(3)
    points, features, verified = rng.normal(size=(POINTS, 3)) * 0.06, [], {}
    for pose in ORBIT:
        uv, _ = project(K, inverse_rigid(pose), np.zeros(5), points)
        features.append(Features((uv + rng.normal(size=uv.shape) * 0.2).astype(np.float32), np.zeros((POINTS, 128))))
    for i in range(COUNT):
        for j in range(i + 1, min(i + 4, COUNT)):
            common = np.sort(rng.choice(POINTS, 120, replace=False))
            F, _ = cv2.findFundamentalMat(features[i].uv[common], features[j].uv[common], cv2.FM_8POINT)
            verified[i, j] = Verified(F, np.stack([common] * 2, 1).astype(np.uint32))
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=280, params=[300.0, 160, 140, 0])
    write_database(tmp_path / "matches.db", [camera], [0] * COUNT, features, verified)
    return tmp_path / "matches.db"


def part(database: Path, photos: range, orbit: list[F64] = ORBIT) -> pycolmap.Reconstruction:
    """A model of some photos."""
    poses = {f"{i:05d}": inverse_rigid(orbit[i]) for i in photos}
    folder = database.parent / "part"
    folder.mkdir(exist_ok=True)
    return with_points(with_poses(database, poses), database, folder, 4.0, 0)


def centres(model: pycolmap.Reconstruction) -> F64:
    """(COUNT, 3) by name; NaN of photos without a camera."""
    out = np.full((COUNT, 3), np.nan)
    for image in model.images.values():
        out[int(image.name)] = image.projection_center()
    return out


def off(model: pycolmap.Reconstruction) -> float:
    """Largest distance of a camera from the truth, after the best similarity; every photo must have one."""
    at, truth = centres(model), np.stack([p[:3, 3] for p in ORBIT])
    assert np.isfinite(at).all()
    moved = pycolmap.estimate_sim3d(at, truth)
    return float(np.linalg.norm(np.array([moved * c for c in at]) - truth, axis=1).max())


def test_two_models_with_shared_photos_become_one(database: Path, tmp_path: Path) -> None:
    one, two = part(database, range(9)), part(database, range(6, COUNT))
    two.transform(ONTO)
    (found,) = merged([one, two], database, tmp_path / "merged", 0)
    assert off(found) < 0.003 * 0.6
    assert found.compute_mean_reprojection_error() < 0.4 and found.num_points3D() > 0.9 * POINTS
    seen = {p.point3D_id for p in found.find_image_with_name("00000").points2D if p.has_point3D()}
    shared = {p.point3D_id for p in found.find_image_with_name("00003").points2D if p.has_point3D()}
    assert len(seen & shared) > 80  # points go through both parts


def test_a_third_model_may_be_linked_by_the_second(database: Path, tmp_path: Path) -> None:
    parts = [part(database, photos) for photos in (range(6), range(8, COUNT), range(3, 11))]
    parts[1].transform(ONTO)
    parts[2].transform(pycolmap.Sim3d(0.3, ONTO.rotation.inverse(), -ONTO.translation))
    (found,) = merged(parts, database, tmp_path / "merged", 0)
    assert off(found) < 0.01 * 0.6


def test_too_few_shared_photos_leave_two(database: Path, tmp_path: Path) -> None:
    one, two = part(database, range(8)), part(database, range(6, COUNT))  # two
    assert similarity(two, one) is None
    assert merged([one, two], database, tmp_path / "merged", 0) == [one, two]
    assert not (tmp_path / "merged").exists()


def test_models_whose_shared_photos_contradict_each_other_stay_apart(database: Path, tmp_path: Path) -> None:
    for wrong in ((5, 6, 7, 8, 9), (5, 6, 7)):  # all shared photos, or most of them: then the alignment succeeds
        elsewhere = [ORBIT[(i + 4) % COUNT] if i in wrong else p for i, p in enumerate(ORBIT)]
        one, two = part(database, range(10)), part(database, range(5, COUNT), elsewhere)
        assert similarity(two, one) is None
        assert len(merged([one, two], database, tmp_path / "merged", 0)) == 2


def test_the_similarity_is_the_one_between_them(database: Path) -> None:
    one, two = part(database, range(9)), part(database, range(5, COUNT))
    two.transform(ONTO)
    found = similarity(two, one)
    assert found is not None and found.scale == pytest.approx(1 / ONTO.scale, rel=1e-2)
    two.transform(found)
    both = np.isfinite(centres(one)) & np.isfinite(centres(two))
    assert np.abs(centres(one) - centres(two))[both].max() < 0.01


def test_one_model_stays_the_same_object(database: Path, tmp_path: Path) -> None:
    one = part(database, range(9))
    assert merged([one], database, tmp_path / "merged", 0) == [one]
    assert merged([], database, tmp_path / "merged", 0) == []
