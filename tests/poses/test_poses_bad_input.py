"""Captures as users bring them: each fault is named with the file and the remedy, and the rest goes on without it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import StageError
from pipeline.transforms import inverse_rigid, matrix, rigid
from stages.poses.epipolar_check import epipolar_pixels, near_pairs
from tests.support.textured_ball import camera_on_orbit, photograph, write_facescape

SIZE = (320, 280)
K = np.array([[700.0, 0, 160.0], [0, 700.0, 140.0], [0, 0, 1]])
ORBIT = [camera_on_orbit(14.0 * i - 42, 12.0 * (i % 2), 0.6, np.zeros(3)) for i in range(7)]


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven photos of the ball and their cameras."""
    folder = tmp_path_factory.mktemp("ball")
    write_facescape(folder, ORBIT, K, SIZE)
    return folder


def copied(ball: Path, folder: Path, *, cameras: bool) -> Path:
    folder.mkdir()
    for p in ball.iterdir():
        if cameras or p.suffix == ".jpg":
            (folder / p.name).write_bytes(p.read_bytes())
    return folder


# ------------------------------------------------------------------ cameras that don't match the photos
@pytest.mark.slow
def test_one_camera_that_is_not_its_photos_is_left_out(ball: Path, tmp_path: Path, capture_of, place) -> None:
    folder = copied(ball, tmp_path / "c", cameras=True)
    params = json.loads((folder / "params.json").read_text())
    wrong = inverse_rigid(camera_on_orbit(5.0, -25.0, 0.6, np.array([0.03, 0.02, 0])))
    params["3_Rt"] = wrong[:3].tolist()
    (folder / "params.json").write_text(json.dumps(params))
    found = place(capture_of(folder)).artifact
    assert found.unregistered == ("3.jpg",) and len(found.cameras) == 6
    assert "3.jpg is left out" in found.warnings[0] and "check its file name" in found.warnings[0]
    assert len(place(capture_of(folder), check=False).artifact.cameras) == 7


def test_photos_in_another_order_than_their_cameras(ball: Path, tmp_path: Path, capture_of, place) -> None:
    folder = copied(ball, tmp_path / "c", cameras=True)
    for i in range(7):
        (folder / f"{i}.jpg").write_bytes((ball / f"{(3 * i + 2) % 7}.jpg").read_bytes())
    found = place(capture_of(folder)).artifact
    assert len(found.cameras) == 7 and found.unregistered == ()  # nobody knows which are right
    source = {f.check: f for f in found.findings}["cameras_against_photos"]
    assert source.level == "unusable" and "the photos contradict" in source.said
    assert "poses.method=colmap" in source.remedy and len(source.views) > 3 and source.views[0].endswith(".jpg")


def test_right_cameras_pass_the_check(ball: Path, capture_of, place) -> None:
    found = place(capture_of(ball)).artifact
    assert found.unregistered == () and found.warnings == ()


def test_epipolar_distance_is_the_shift_of_a_point(ball: Path, capture_of, place) -> None:
    a, b = place(capture_of(ball), check=False).artifact.cameras[:2]
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (30, 3))
    uv = []
    for c in (a, b):
        p = points @ np.linalg.inv(matrix(c.world_from_cam))[:3, :3].T + np.linalg.inv(matrix(c.world_from_cam))[:3, 3]
        uv.append(p[:, :2] / p[:, 2:] * c.K[0][0] + (c.K[0][2], c.K[1][2]))
    assert epipolar_pixels(a, b, uv[0], uv[1]).max() < 1e-6
    moved = epipolar_pixels(a, b, uv[0], uv[1] + (0, 3.0))
    assert np.all(moved < 3.0) and np.median(moved) > 1.0  # Sampson: shared between both photos
    assert len(near_pairs([a, b])) == 1


def test_cameras_in_one_spot(tmp_path: Path, capture_of, place) -> None:
    turned = [rigid(cv2.Rodrigues(np.array([0, np.radians(4.0 * i), 0]))[0] @ ORBIT[3][:3, :3], ORBIT[3][:3, 3])
              for i in range(5)]  # fmt: skip
    write_facescape(tmp_path / "c", turned, K, SIZE, pictures=False)
    with pytest.raises(StageError, match="all in one spot") as caught:
        place(capture_of(tmp_path / "c"))
    assert "walk around" in caught.value.remedy


# ------------------------------------------------------------------ photos alone
@pytest.mark.slow
def test_photos_from_one_spot(tmp_path: Path, capture_of, place) -> None:
    folder = tmp_path / "c"
    folder.mkdir()
    for i in range(6):
        turn = cv2.Rodrigues(np.radians([2.0 * (i % 2), 2.5 * i - 6, 3.0 * i]))[0]
        pose = rigid(ORBIT[3][:3, :3] @ turn, ORBIT[3][:3, 3])
        cv2.imwrite(str(folder / f"{i}.png"), photograph(pose, K, SIZE)[..., ::-1])
    with pytest.raises(StageError, match="one spot") as caught:
        place(capture_of(folder), attempts=1)
    assert "walk around" in caught.value.remedy


@pytest.mark.slow
def test_two_scenes_a_mirrored_and_a_rotated_photo(ball: Path, tmp_path: Path, capture_of, place) -> None:
    """Mirrored photos of the ball fit each other like photos of another ball; one that is turned fits the rest."""
    folder = copied(ball, tmp_path / "c", cameras=False)
    for i in range(3):
        mirrored = cv2.flip(cv2.imread(str(ball / f"{i}.jpg")), 1)
        cv2.imwrite(str(folder / f"{i + 20}.png"), mirrored)
    pose = camera_on_orbit(3.0, 6.0, 0.6, np.zeros(3))
    cv2.imwrite(str(folder / "40.png"), np.rot90(photograph(pose, K, SIZE)[..., ::-1]))
    found = place(capture_of(folder), max_features=700, attempts=1).artifact
    assert found.unregistered == ("20.png", "21.png", "22.png")
    assert {c.name for c in found.cameras} >= {"40.png", "0.jpg"} and len(found.cameras) == 8
    assert set(found.view_errors_px) == {c.name for c in found.cameras}
    source = "\n".join(found.warnings)
    assert "20.png, 21.png, 22.png (other group)" in source and "a separate capture" in source
    assert found.groups == (8, 3) and all("fits 2 more photos" in reason for reason in found.left_out.values())
