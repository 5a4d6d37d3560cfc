"""Held-out photos get their cameras from the finished model, and nothing of them is in it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.transforms import F64, inverse_rigid, matrix, project, rows
from stages.poses import sfm_result
from stages.poses.config import Config
from stages.poses.epipolar_check import check_cameras, features_of, near_pairs
from stages.poses.mapper import DEFAULT_FOCAL, Model, Pose
from stages.poses.matching import Verified
from stages.poses.register import Lens, lens_of, register, sightings
from stages.poses.scale_source import known_scale
from tests.support.textured_ball import camera_on_orbit, photograph, write_facescape

SIZE = (640, 480)
K = np.array([[700.0, 0, 325.0], [0, 705.0, 236.0], [0, 0, 1]])
BENT = (0.05, -0.02, 0.001, -0.002, 0.004)
RNG = np.random.default_rng(4)
POINTS = RNG.uniform(-0.12, 0.12, (200, 3))
TRUE = camera_on_orbit(25.0, 10.0, 0.6, np.zeros(3))


def seen(points: F64 = POINTS, pose: F64 = TRUE, k: F64 = K, noise: float = 0.0) -> F64:
    uv, _ = project(k, inverse_rigid(pose), np.array(BENT), points)
    return uv + noise * np.random.default_rng(1).normal(size=uv.shape)


def off(pose: F64, true: F64 = TRUE) -> tuple[float, float]:
    """Distance of the centres, and angle in radians."""
    turn = np.trace(pose[:3, :3].T @ true[:3, :3])
    return float(np.linalg.norm(pose[:3, 3] - true[:3, 3])), float(np.arccos(np.clip((turn - 1) / 2, -1, 1)))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 50.0, 1e3])
def test_a_camera_is_found_from_points_and_pixels_in_a_world_of_any_size(scale: float) -> None:
    pose = TRUE.copy()
    pose[:3, 3] *= scale
    found = register(seen(), POINTS * scale, Lens(K, BENT, False), SIZE, 0)
    assert found is not None and found.matches == len(POINTS) and found.error_px < 1e-3
    distance, angle = off(found.pose.world_from_cam, pose)
    assert distance < 1e-5 * scale and angle < 1e-5
    assert np.array_equal(found.pose.K, K) and found.pose.distortion == BENT


def test_wrong_matches_do_not_move_it() -> None:
    """A third of the points are seen elsewhere; the rest has .5 pixel of noise: as good as least squares without them
    (a hundred pixels of noise-free depth would be .5 / 700 of the distance, divided by the root of the number)."""
    uv = seen(noise=0.5)
    uv[::3] = np.random.default_rng(2).uniform(0, 480, (len(uv[::3]), 2))
    found = register(uv, POINTS, Lens(K, BENT, False), SIZE, 0)
    clean = register(np.delete(uv, np.s_[::3], 0), np.delete(POINTS, np.s_[::3], 0), Lens(K, BENT, False), SIZE, 0)
    assert found is not None and clean is not None
    assert abs(found.matches - clean.matches) <= 3 and found.error_px == pytest.approx(clean.error_px, abs=0.05)
    assert off(found.pose.world_from_cam)[0] < 1e-3 and off(clean.pose.world_from_cam)[0] < 1e-3
    assert register(uv, POINTS, Lens(K, BENT, False), SIZE, 0).pose.world_from_cam.tobytes() == (  # type: ignore[union-attr]
        found.pose.world_from_cam.tobytes()
    )


def test_what_fits_no_camera_gets_none() -> None:
    """Too few matches, matches of chance, and fewer than a quarter that fit."""
    chance = np.random.default_rng(3).uniform(0, 480, (200, 2))
    lens = Lens(K, BENT, False)
    assert register(seen()[:29], POINTS[:29], lens, SIZE, 0) is None
    assert register(seen()[:30], POINTS[:30], lens, SIZE, 0) is not None
    assert register(chance, POINTS, lens, SIZE, 0) is None
    assert register(np.concatenate([seen()[:40], chance[40:]]), POINTS, lens, SIZE, 0) is None
    assert register(np.concatenate([seen()[:40], chance[40:]]), POINTS, lens, SIZE, 0, share=0.15) is not None
    assert register(seen()[:12], POINTS[:12], lens, SIZE, 0, least=12) is not None
    assert register(np.zeros((0, 2)), np.zeros((0, 3)), lens, SIZE, 0) is None
    assert register(seen(), np.zeros_like(POINTS), lens, SIZE, 0) is None


def test_a_lens_that_is_not_known_gets_its_focal_length() -> None:
    start = K.copy()
    start[0, 0] = start[1, 1] = 780.0
    found = register(seen(), POINTS, Lens(start, BENT, True), SIZE, 0)
    assert found is not None and found.pose.K[0, 0] == pytest.approx(700, rel=2e-3)
    assert off(found.pose.world_from_cam)[0] < 2e-3
    kept = register(seen(), POINTS, Lens(start, BENT, False), SIZE, 0)
    assert kept is None or kept.pose.K[0, 0] == 780.0


def photo(group: str, focal: float | None = None) -> Any:
    return SimpleNamespace(group=group, focal=focal, width=640, height=480)


def model_of(focals: list[float]) -> Model:
    poses = {i: Pose(np.diag([f, f, 1.0]), np.eye(4), BENT) for i, f in enumerate(focals)}
    return Model(poses, POINTS, *(np.zeros(len(POINTS)),) * 2, 0.5, {})


def test_the_lens_is_that_of_the_same_group() -> None:
    fitted = [photo("a"), photo("a"), photo("b")]
    found = lens_of(photo("a"), fitted, model_of([700, 700, 900]))
    assert (found.K[0, 0], found.distortion, found.free) == (700, BENT, False)
    assert lens_of(photo("b"), fitted, model_of([700, 700, 900])).K[0, 0] == 900
    apart = lens_of(photo("a"), [photo("a")] * 3, model_of([700, 730, 710]))
    assert apart.K[0, 0] == 710 and apart.free
    other = lens_of(photo("c", 650.0), fitted, model_of([700, 700, 900]))
    assert other.K[0, 0] == 650 and other.free and other.distortion == (0.0,) * 5
    assert lens_of(photo("c"), fitted, model_of([700, 700, 900])).K[0, 0] == DEFAULT_FOCAL * 640


def test_matches_with_observations_of_points_are_sightings() -> None:
    """By hand: feature 1 of photo 0 observes point 7, its feature 2 none, feature 0 of photo 2 the same point 7."""
    model = model_of([700, 700, 700])
    model = Model(*(getattr(model, n) for n in ("poses", "points", "error_px", "track", "reprojection_error_px",
                                                 "view_error_px")),
                  seen={0: np.array([[1, 7], [3, 9]]), 1: np.array([[5, 5]]), 2: np.array([[0, 7]])})  # fmt: skip
    verified = {
        (0, 4): Verified(np.eye(3), np.array([[1, 6], [2, 8], [3, 2]], np.uint32)),
        (2, 4): Verified(np.eye(3), np.array([[0, 6]], np.uint32)),
        (1, 3): Verified(np.eye(3), np.array([[5, 1]], np.uint32)),
    }
    np.testing.assert_array_equal(sightings(4, model, verified), [[2, 9], [6, 7]])
    assert sightings(5, model, verified).shape == (0, 2)
    # a photo without a camera may come first in a pair, and observations of photos that have none do not count
    turned = {(0, 2): Verified(np.eye(3), np.array([[4, 0]], np.uint32)), (0, 7): verified[0, 4]}
    np.testing.assert_array_equal(sightings(0, model, turned), [[4, 7]])


# ------------------------------------------------------------------ the stage
ORBIT = [camera_on_orbit(12.0 * i - 42, 12.0 * (i % 2), 0.6, np.zeros(3)) for i in range(8)]
SMALL, LENS = (320, 280), np.array([[700.0, 0, 160.0], [0, 700.0, 140.0], [0, 0, 1]])


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight photos of a textured ball, without parameters."""
    folder = tmp_path_factory.mktemp("ball")
    write_facescape(folder, ORBIT, LENS, SMALL)
    (folder / "params.json").unlink()
    return folder


def with_another(ball: Path, to: Path, number: int) -> Path:
    """The same photos, one of them of something else."""
    to.mkdir()
    for p in ball.glob("*.jpg"):
        (to / p.name).write_bytes(p.read_bytes())
    noise = cv2.GaussianBlur(np.random.default_rng(9).integers(0, 255, (*SMALL[::-1], 3), np.uint8), (0, 0), 2)
    cv2.imwrite(str(to / f"{number}.jpg"), np.asarray(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)))  # type: ignore[call-overload]
    return to


@pytest.mark.slow
def test_a_held_out_photo_is_found_where_it_was_taken_and_changes_nothing(
    ball: Path, tmp_path: Path, capture_of, place
) -> None:
    found = place(capture_of(ball, holdout="every:5:2", drop_blurred=False))
    cameras = {c.index: matrix(c.world_from_cam) for c in found.artifact.cameras}
    assert sorted(cameras) == list(range(8)) and found.artifact.left_out == {}
    own = [i for i in cameras if i not in (2, 7)]
    a, b = (np.stack([p[i][:3, 3] for i in own]) for p in (cameras, ORBIT))  # type: ignore[index]
    u, s, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    scale, turn = s.sum() / ((a - a.mean(0)) ** 2).sum(), u @ vt
    for i in (2, 7):
        at = scale * turn @ (cameras[i][:3, 3] - a.mean(0)) + b.mean(0)
        assert np.linalg.norm(at - ORBIT[i][:3, 3]) < 0.01, (
            i
        )  # 1.7 % of the distance, among photos that are 12 degrees apart
    assert set(found.artifact.view_errors_px) == {f"{i}.jpg" for i in range(8)}

    other = place(capture_of(with_another(ball, tmp_path / "other", 2), holdout="every:5:2", drop_blurred=False))
    assert list(other.artifact.left_out) == ["2.jpg"] and "held out" in other.artifact.left_out["2.jpg"]
    left = {c.index: matrix(c.world_from_cam) for c in other.artifact.cameras}
    assert sorted(left) == [0, 1, 3, 4, 5, 6, 7] and all(np.array_equal(left[i], cameras[i]) for i in left)
    assert other.artifact.capture_from_asset == found.artifact.capture_from_asset
    assert other.path(other.artifact.points).read_bytes() == found.path(found.artifact.points).read_bytes()


def test_only_fitted_photos_are_solved(ball: Path, capture_of, place, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def solve(photos: Any, *_: Any) -> Any:
        given.extend(p.image.name for p in photos)
        raise KeyboardInterrupt

    monkeypatch.setattr(sfm_result, "solve", solve)
    with pytest.raises(KeyboardInterrupt):
        place(capture_of(ball, holdout="every:5:2", drop_blurred=False))
    assert len(given) == 6


def around() -> list[Camera]:
    return [Camera(index=i, name=f"{i}.jpg", width=SMALL[0], height=SMALL[1], K=rows(LENS), world_from_cam=rows(p),
                   distortion=(0,) * 5) for i, p in enumerate(ORBIT)]  # fmt: skip


def test_a_held_out_photo_contradicts_no_other_and_is_still_found() -> None:
    """A photo of something else under the camera of a held-out view: it alone is wrong; the others' shares are those of
    a capture without it."""
    pictures: list[Any] = [photograph(p, LENS, SMALL) for p in ORBIT]
    turned = pictures[:3] + [np.ascontiguousarray(photograph(ORBIT[6], LENS, SMALL))] + pictures[4:]

    def shares(photos: list[Any], held: set[int]) -> Any:
        as_photos = [SimpleNamespace(width=SMALL[0], height=SMALL[1], pixels=lambda p=p: p, inside=lambda: None)
                     for p in photos]  # fmt: skip
        return check_cameras(around(), features_of(as_photos, lambda *_: None), 0, lambda *_: None, held=held).share

    wrong, right = shares(turned, {3}), shares(pictures, {3})
    assert wrong[3] < 0.3 <= right[3]
    np.testing.assert_array_equal(np.delete(wrong, 3), np.delete(right, 3))
    assert all(3 not in p for p in near_pairs(around(), {3}) if p[0] != 3 and p[1] != 3)
    assert sum(3 in p for p in near_pairs(around(), {3})) == 4


@pytest.mark.parametrize("source", ["markers", "gps"])
def test_held_out_photos_say_nothing_of_the_scale(source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[int]] = []
    views = [SimpleNamespace(index=i, holdout=i in (2, 7), place_m=(0.0, 0.0, float(i))) for i in range(8)]
    capture: Any = SimpleNamespace(artifact=SimpleNamespace(views=views))

    def by_markers(seen: Any, side: float) -> Any:
        asked.append([c.index for c, _ in seen])
        return "a scale"

    def by_positions(cameras: Any, places: Any) -> Any:
        asked.append([c.index for c in cameras])
        return "a scale", ""

    monkeypatch.setattr("stages.poses.scale_source.by_markers", by_markers)
    monkeypatch.setattr("stages.poses.scale_source.by_positions", by_positions)
    monkeypatch.setattr("stages.poses.scale_source.find_markers", lambda *_: {})
    monkeypatch.setattr("stages.poses.scale_source._grey", lambda *_: None)
    config = Config(scale=source, marker_mm=20.0 if source == "markers" else 0.0)  # type: ignore[arg-type]
    assert known_scale(capture, around(), config, None, []) == "a scale"
    assert asked == [[0, 1, 3, 4, 5, 6]]
