"""Given cameras go through unchanged, but for the frame."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.errors import UsageError
from pipeline.transforms import apply, matrix, project, rows
from stages.poses import given_cameras, sfm
from stages.poses.config import Config
from stages.poses.epipolar_check import FAR, IMPERFECT
from tests.support.textured_ball import camera_on_orbit, flat, write_facescape

SIZE = (96, 80)
K = np.array([[250.0, 0, 49.0], [0, 251.0, 39.5], [0, 0, 1]])
TARGET = np.array([0.1, 1.5, -0.2])


def facescape(folder: Path, scale: float = 1.0) -> dict:
    poses = [camera_on_orbit(20.0 * i - 60, 8, 1.1, TARGET) for i in range(7)]
    for p in poses:
        p[:3, 3] *= scale
    return write_facescape(folder, poses, K, SIZE, pictures=False)


@pytest.mark.parametrize("scale", [1.0, 1000.0, 7.7])
def test_from_params_to_pixels(tmp_path: Path, capture_of, place, scale: float) -> None:
    """Oracle: cv2.projectPoints on the file's numbers. Asset points go through capture_from_asset into its world."""
    params = facescape(tmp_path / "c", scale)
    distortion = [0.03, -0.01, 0.001, 0.002, 0.004]
    params |= {f"{i}_distortion": distortion for i in range(7)}
    (tmp_path / "c" / "params.json").write_text(json.dumps(params))
    found = place(capture_of(tmp_path / "c", holdout="every:3:1")).artifact
    assert found.source == "given" and found.unregistered == () and found.points is None
    assert found.metric == (scale != 7.7) and bool(found.warnings) == (scale != 1.0)
    asset = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3))
    world = apply(matrix(found.capture_from_asset), asset)
    for camera in found.cameras:
        centre_K, Rt = (np.array(params[f"{camera.index}_{k}"]) for k in ("K", "Rt"))
        turn = cv2.Rodrigues(Rt[:, :3])[0]
        expected = cv2.projectPoints(world, turn, Rt[:, 3], centre_K, np.array(distortion))[0][:, 0] + 0.5
        pose = np.linalg.inv(matrix(camera.world_from_cam))
        np.testing.assert_allclose(project(matrix(camera.K), pose, np.array(camera.distortion), asset)[0], expected,
                                   atol=1e-6)  # fmt: skip
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert [c.index for c in found.cameras] == list(range(7))  # held-out views have cameras too


def test_the_manifest_is_the_same_every_time(tmp_path: Path, capture_of, place) -> None:
    facescape(tmp_path / "c")
    capture = capture_of(tmp_path / "c")
    assert place(capture).artifact.digest() == place(capture).artifact.digest()


def test_given_without_cameras_is_a_usage_error(tmp_path: Path, capture_of, place) -> None:
    (tmp_path / "c").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / "c" / f"{i}.jpg"), flat(SIZE, i))
    with pytest.raises(UsageError, match="poses.method"):
        place(capture_of(tmp_path / "c"), method="given")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["head_a", "head_b"])
def test_shared_captures(name: str, repo: Path, capture_of, place) -> None:
    folder = repo.parent / "shared" / "captures" / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    capture = capture_of(folder, holdout="every:5:2")
    found = place(capture).artifact
    assert len(found.cameras) == len(capture.artifact.views) == 54 and found.metric
    assert 0.15 < found.roi_radius < 0.2 and found.warnings == ()


def cameras_around(distance: float) -> list[Camera]:
    return [
        Camera(index=i, name=f"{i}.jpg", width=SIZE[0], height=SIZE[1], K=rows(K), distortion=(0,) * 5,
               world_from_cam=rows(camera_on_orbit(40.0 * i, 8, distance, TARGET)))
        for i in range(5)
    ]  # fmt: skip


@pytest.mark.parametrize(("given", "limit"), [("refine", IMPERFECT), ("triangulate", FAR)])
def test_cameras_that_are_refined_may_be_less_exact(monkeypatch: pytest.MonkeyPatch, given: str, limit: float) -> None:
    """The check that finds a photo of another camera asks for less, where the fit of the cameras mends the rest."""
    asked: list[tuple[float, set[int]]] = []
    cameras: Any = cameras_around(1.0)
    verdict = SimpleNamespace(share=np.ones(5), wrong=[], known=5)
    monkeypatch.setattr(given_cameras, "photos_of", lambda capture: [])
    monkeypatch.setattr(given_cameras, "progress_of", lambda context: None)
    monkeypatch.setattr(given_cameras, "features_of", lambda *a: [])
    monkeypatch.setattr(given_cameras, "find_mirrored", lambda *a: [])
    views = [SimpleNamespace(holdout=i == 3) for i in range(5)]
    capture: Any = SimpleNamespace(artifact=SimpleNamespace(views=views))
    monkeypatch.setattr(given_cameras, "check_cameras", lambda *a: asked.append(a[-2:]) or verdict)
    wrong, _ = given_cameras._contradicted(capture, cameras, Config(given=given), None)  # type: ignore[arg-type]
    assert asked == [(limit, {3})] and wrong == [] and IMPERFECT > FAR


@pytest.mark.parametrize("distance", [1.0, 250.0])
def test_given_centres_may_move_by_a_share_of_their_distance(monkeypatch: pytest.MonkeyPatch, distance: float) -> None:
    """In whatever unit the cameras are given."""
    told: dict[str, Any] = {}

    def triangulated(*a: Any, **options: Any) -> Any:
        told.update(options)
        return SimpleNamespace(poses=[]), []

    monkeypatch.setattr(sfm, "triangulate_given", triangulated)
    monkeypatch.setattr(given_cameras, "photos_of", lambda capture: list(range(5)))
    monkeypatch.setattr(given_cameras, "progress_of", lambda context: None)
    capture: Any = SimpleNamespace(artifact=SimpleNamespace(kind="photos", views=[]))
    config = Config(given="triangulate", given_deviation=0.02)
    context: Any = SimpleNamespace(scratch=None)
    given_cameras._triangulated(capture, list(range(5)), cameras_around(distance), config, context)
    assert told["deviation"] == pytest.approx(0.02 * distance, rel=1e-3) and told["refine"] is False
