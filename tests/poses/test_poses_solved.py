"""Cameras from photos alone: a textured ball whose cameras are known, and photos that cannot be placed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import Cancelled, StageError
from pipeline.transforms import F64, matrix
from stages.poses.config import Config
from stages.poses.detect import detect_all, match_all
from stages.poses.feature_sets import FeatureSet
from stages.poses.features import ASIFT, DENOISED, PLAIN, detect, grey8
from stages.poses.mapper import opencv_distortion
from stages.poses.matching import Verified, joined, match, promising_pairs, verify, without_repeats
from stages.poses.oblique import with_oblique
from stages.poses.photos import photos_of
from tests.support.textured_ball import camera_on_orbit, photograph, write_facescape

SIZE = (320, 280)
K = np.array([[700.0, 0, 160.0], [0, 700.0, 140.0], [0, 0, 1]])
ORBIT = [camera_on_orbit(14.0 * i - 42, 12.0 * (i % 2), 0.6, np.zeros(3)) for i in range(7)]


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven photos of the ball, without parameters."""
    folder = tmp_path_factory.mktemp("ball")
    write_facescape(folder, ORBIT, K, SIZE)
    (folder / "params.json").unlink()
    return folder


def aligned(found: F64, truth: F64) -> tuple[float, F64, F64]:
    """(scale, R, residuals) of truth ~ scale R found + t, by least squares (Umeyama 1991)."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    d = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    R = u @ np.diag(d) @ vt
    scale = float((s * d).sum() / (a**2).sum())
    return scale, R, np.linalg.norm(scale * a @ R.T - b, axis=1)


@pytest.mark.slow
def test_cameras_of_a_ball_are_found(ball: Path, capture_of, place) -> None:
    capture = capture_of(ball)
    located = place(capture)
    found = located.artifact
    assert found.source == "colmap" and not found.metric and found.unregistered == ()
    assert found.roi_radius == pytest.approx(0.18) and found.reprojection_error_px < 0.6
    poses = np.stack([matrix(c.world_from_cam) for c in found.cameras])
    truth = np.stack([ORBIT[c.index] for c in found.cameras])
    scale, R, residual = aligned(poses[:, :3, 3], truth[:, :3, 3])
    assert residual.max() < 0.003  # 0.5 % of the distance: the focal length is solved too
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", truth[:, :3, :3], poses[:, :3, :3]))
    for p, t in zip(poses, truth, strict=True):  # after the rotation that fits all of them best
        assert np.degrees(np.arccos((np.trace(u @ vt @ p[:3, :3] @ t[:3, :3].T) - 1) / 2)) < 0.6
    assert found.cameras[0].K[0][0] == pytest.approx(700, rel=0.03)
    np.testing.assert_allclose(R, np.eye(3), atol=0.05)  # upright, facing the cameras
    # the sparse points lie on the ball
    with np.load(located.path(found.points), allow_pickle=False) as f:
        points, error, track = f["points"], f["error_px"], f["track"]
    centre = poses[:, :3, 3].mean(0) + R.T @ (0 - truth[:, :3, 3].mean(0)) / scale
    radius = np.linalg.norm(points - centre, axis=1) * scale
    assert len(points) == len(error) == len(track) > 100 and track.min() >= 2
    assert np.median(radius) == pytest.approx(0.1, rel=0.03)
    assert place(capture).artifact.digest() == found.digest()  # and the same again


@pytest.mark.slow
def test_photos_of_something_else_are_named(ball: Path, tmp_path: Path, capture_of, place) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    for p in sorted(ball.glob("*.jpg")):
        (folder / p.name).write_bytes(p.read_bytes())
    rng = np.random.default_rng(9)
    for i in (20, 21):
        noise = cv2.GaussianBlur(rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8), (0, 0), 2)
        cv2.imwrite(str(folder / f"{i}.jpg"), cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX))
    capture = capture_of(folder, drop_blurred=False)
    found = place(capture, attempts=2).artifact
    assert found.unregistered == ("20.jpg", "21.jpg") and "20.jpg, 21.jpg (" in found.warnings[-1]
    assert list(found.left_out) == ["20.jpg", "21.jpg"] and found.groups == (7,)
    assert all(reason.split(":")[0] in ("no match", "blurred") for reason in found.left_out.values())


@pytest.mark.slow
def test_too_few_placed_photos_are_unusable_and_the_others_are_named(
    ball: Path, tmp_path: Path, capture_of, place
) -> None:
    folder = no_overlap(tmp_path / "mixed")
    for i in range(4):
        (folder / f"{i + 10}.jpg").write_bytes((ball / f"{i}.jpg").read_bytes())
    found = place(capture_of(folder), attempts=2).artifact
    assert set(found.unregistered) == {"0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg"}
    (placed,) = (f for f in found.findings if f.check == "photos_placed")
    assert placed.level == "unusable" and set(placed.views) == set(found.unregistered)


@pytest.mark.slow
def test_masks_keep_features_on_the_subject(ball: Path, tmp_path: Path, capture_of, place) -> None:
    """A background that stands still while the subject turns would win without them."""
    folder = tmp_path / "turntable"
    (folder / "mask").mkdir(parents=True)
    wall = np.random.default_rng(2).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
    wall = cv2.normalize(cv2.GaussianBlur(wall, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    for i, pose in enumerate(ORBIT):
        picture = photograph(pose, K, SIZE)[..., ::-1]
        subject = picture.any(2)
        cv2.imwrite(str(folder / f"{i}.jpg"), np.where(subject[..., None], picture, wall))
        cv2.imwrite(str(folder / "mask" / f"{i}.png"), subject.astype(np.uint8) * 255)
    found = place(capture_of(folder)).artifact
    centres = np.stack([matrix(c.world_from_cam)[:3, 3] for c in found.cameras])
    _, _, residual = aligned(centres, np.stack([ORBIT[c.index][:3, 3] for c in found.cameras]))
    assert len(centres) == 7 and residual.max() < 0.01


def no_overlap(folder: Path) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(3)
    for i in range(5):
        noise = cv2.GaussianBlur(rng.integers(0, 255, (240, 260, 3), np.uint8), (0, 0), 1.5)
        cv2.imwrite(str(folder / f"{i}.jpg"), cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX))
    return folder


def test_photos_without_overlap_fail_clearly(tmp_path: Path, capture_of, place) -> None:
    with pytest.raises(StageError) as caught:
        place(capture_of(no_overlap(tmp_path / "c")), attempts=1)
    error = caught.value
    assert error.where == "poses" and "of 5 have a camera" in error.value and "0.jpg" in error.value
    assert "overlapping" in error.remedy and error.limit == "at least 3 that are not held out"


def test_photos_without_any_feature_fail_clearly(tmp_path: Path, capture_of, place) -> None:
    (tmp_path / "c").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / "c" / f"{i}.jpg"), np.tile(np.linspace(60, 90 + i, 200), (200, 1)))
    with pytest.raises(StageError, match="have no matches"):
        place(capture_of(tmp_path / "c"), attempts=1)


def test_the_user_can_stop_it(ball: Path, capture_of, place) -> None:
    calls = iter(range(1000))
    with pytest.raises(Cancelled):
        place(capture_of(ball), cancelled=lambda: next(calls) > 4)


def test_the_user_can_stop_the_mapper(ball: Path, capture_of, tmp_path: Path) -> None:
    """An exception must not pass through the mapper's own frames, and nothing may stay in scratch."""
    from pipeline.contract import Context
    from stages.poses.stage import Config, Inputs, run

    stop: list[bool] = []

    def progress(done: int, total: int, message: str = "", **figures: float) -> None:
        if "registering" in message:
            stop.append(True)

    work, scratch = tmp_path / "w", tmp_path / "s"
    work.mkdir()
    scratch.mkdir()
    with pytest.raises(Cancelled):
        run(Inputs(capture_of(ball)), Config(), Context(work, scratch, "cpu", progress, lambda: bool(stop)))
    assert len(stop) == 1 and not list(scratch.iterdir())


# ------------------------------------------------------------------ small parts
def test_features_sit_where_they_are_seen_at_any_reduction() -> None:
    """A round blob's centre is found within a tenth of a pixel, first pixel's centre at 0.5, reduced or not."""
    y, x = np.mgrid[0:200, 0:240] + 0.5
    picture = 30 + 200 * np.exp(-((x - 100.3) ** 2 + (y - 80.8) ** 2) / 2 / 6**2)
    for edge in (1000, 120):
        grey = grey8(np.repeat(picture[..., None], 3, 2).astype(np.uint8), edge)
        found = detect(grey, (240, 200), 50)
        distance = np.linalg.norm(found.uv - [100.3, 80.8], axis=1).min()
        assert grey.shape == ((200, 240) if edge == 1000 else (100, 120)) and distance < 0.1
        np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)


def test_features_are_spread_masked_and_repeatable() -> None:
    picture = np.full((400, 400), 100, np.uint8)
    rng = np.random.default_rng(0)
    picture[:100, :100] = rng.integers(0, 255, (100, 100))  # one corner is far sharper than the rest
    picture[100:, :] = 100 + 12 * cv2.GaussianBlur(rng.normal(size=(300, 400)), (0, 0), 2).clip(-1, 1)
    found = detect(picture, (400, 400), 200)
    assert len(found.uv) == 200 and (found.uv[:, 1] > 100).mean() > 0.5
    again = detect(picture, (400, 400), 200)
    np.testing.assert_array_equal(found.uv, again.uv)
    inside = np.zeros_like(picture)
    inside[200:] = 1
    assert detect(picture, (400, 400), 200, PLAIN, inside).uv[:, 1].min() > 199
    assert len(detect(np.full((100, 100), 7, np.uint8), (100, 100), 50, DENOISED).uv) == 0


def test_photos_far_apart_match_when_looked_at_askew() -> None:
    """A flat pattern straight on and turned by 65 degrees: its image is squeezed by cos 65."""
    rng = np.random.default_rng(2)
    flat = cv2.normalize(cv2.GaussianBlur(rng.random((240, 300)), (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    turned = cv2.resize(flat, (round(300 * np.cos(np.radians(65))), 240), interpolation=cv2.INTER_AREA)
    counts = []
    for effort in (PLAIN, replace(ASIFT, denoise=False)):
        a, b = (detect(p.astype(np.uint8), p.shape[::-1], 800, effort) for p in (flat, turned))
        pair = Verified(np.eye(3), match(a.descriptors, b.descriptors, effort.ratio))
        kept = without_repeats(pair, a, b, 2.0)
        assert len(kept.matches) <= len(pair.matches)
        uv_a, uv_b = a.uv[kept.matches[:, 0]], b.uv[kept.matches[:, 1]]
        right = np.abs(uv_b - uv_a * (turned.shape[1] / 300, 1)).max(1) < 2
        counts.append(int(right.sum()))
    assert counts[1] > 3 * max(counts[0], 10)


def test_features_seen_askew_come_on_top_of_the_others(ball: Path, capture_of) -> None:
    photos = photos_of(capture_of(ball))[:2]
    config = Config(max_image_size=200, neighbours=4).changed(max_features=150)  # fewer than a user may set
    plain = detect_all(photos, config, PLAIN, lambda *_: None)
    verified = match_all(photos, plain, config, PLAIN, lambda *_: None)
    of = FeatureSet(PLAIN, tuple(plain))
    found, joint = with_oblique(photos, of, verified, config, lambda *_: None, [0])
    both = found.features
    first, second = joint[0, 1].matches.T
    assert len(both[0].uv) > len(plain[0].uv) and first.max() < len(both[0].uv) and second.max() < len(both[1].uv)
    new = joint[0, 1].matches[first >= len(plain[0].uv)]
    assert len(new) >= 15 and (new[:, 1] >= len(plain[1].uv)).all()
    relative = np.linalg.inv(ORBIT[1]) @ ORBIT[0]
    x, y = ((np.c_[f.uv[k] - K[:2, 2], np.full(len(k), K[0, 0])]) for f, k in zip(both, new.T, strict=True))
    line = x @ np.cross(relative[:3, 3], relative[:3, :3].T)  # x (t x R)^T
    off = np.abs((y * line).sum(1)) / np.linalg.norm(line[:, :2], axis=1)
    assert np.median(off) < 2


def test_matches_of_two_kinds_are_joined_behind_each_other() -> None:
    F = np.eye(3)
    one = {(0, 1): Verified(F, np.array([[1, 2], [3, 4], [5, 6]], np.uint32))}
    other = {(0, 1): Verified(2 * F, np.array([[0, 0]], np.uint32)), (1, 2): Verified(F, np.array([[7, 8]], np.uint32))}
    both = joined(one, other, [10, 20, 30])
    np.testing.assert_array_equal(both[0, 1].matches, [[1, 2], [3, 4], [5, 6], [10, 20]])
    np.testing.assert_array_equal(both[1, 2].matches, [[27, 38]])
    assert both[0, 1].F is F  # of the kind that agreed on more


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_grey_of_any_depth(kind: type) -> None:
    ramp = np.linspace(0, 1, 256)
    image = np.repeat(np.tile(ramp, (100, 1))[..., None], 3, 2)
    linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    peak = {np.uint8: 255, np.uint16: 65535}.get(kind)
    stored = (image * peak).round().astype(kind) if peak else linear.astype(np.float32)
    np.testing.assert_allclose(grey8(stored, 1000)[0], ramp * 255, atol=1 if peak else 3)
    assert grey8(stored[..., :1], 64).shape == (25, 64)


def test_match_agrees_with_opencv() -> None:
    """Oracle: brute-force matching with cross check and ratio test, done by cv2."""
    rng = np.random.default_rng(0)
    a = rng.random((300, 128)).astype(np.float32)
    b = np.concatenate([a[::2] + rng.normal(0, 0.15, (150, 128)).astype(np.float32), rng.random((100, 128))])
    a, b = (np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True), np.float32) for d in (a, b))
    found = {tuple(m) for m in match(a, b, 0.85).tolist()}
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher().match(b, a)}
    knn = cv2.BFMatcher().knnMatch(a, b, 2)
    expected = {
        (m.queryIdx, m.trainIdx)
        for m, n in knn
        if back[m.trainIdx] == m.queryIdx and m.distance < 0.85 * n.distance and m.distance < 0.8
    }
    assert found == expected and len(found) > 50
    assert match(a[:1], b, 0.85).shape == (0, 2) and match(a[:0], b, 0.85).shape == (0, 2)


def test_verified_matches_obey_the_true_geometry(ball: Path) -> None:
    features = [detect(grey8(cv2.imread(str(ball / f"{i}.jpg")), 1000), SIZE, 800) for i in (2, 3)]
    matches = match(features[0].descriptors, features[1].descriptors, 0.85)
    rng = np.random.default_rng(0)
    wrong = np.stack([rng.integers(0, len(f.uv), 40) for f in features], 1).astype(np.uint32)
    found = verify(*features, np.concatenate([matches, wrong]), 320, 0)
    assert found is not None and len(found.matches) > 30
    relative = np.linalg.inv(ORBIT[3]) @ ORBIT[2]
    t = relative[:3, 3]
    E = np.cross(np.eye(3), t) @ relative[:3, :3] * -1
    F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
    ends = [np.c_[f.uv[found.matches[:, i]], np.ones(len(found.matches))] for i, f in enumerate(features)]
    lines = ends[0] @ F.T
    distance = np.abs((ends[1] * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
    assert np.quantile(distance, 0.95) < 1.5
    assert verify(*features, wrong[:10], 320, 0) is None


def test_pairs_of_many_photos_are_the_neighbours() -> None:
    """24 photos on a ring that share features with their next two on each side only."""
    rng = np.random.default_rng(0)
    from stages.poses.features import Features

    pool = rng.random((24, 60, 128)).astype(np.float32)
    pool /= np.linalg.norm(pool, axis=2, keepdims=True)
    views = [np.concatenate([pool[(i + k) % 24] for k in range(3)]) for i in range(24)]
    features = [Features(np.zeros((180, 2), np.float32), v) for v in views]
    pairs = set(promising_pairs(features, 0.85, neighbours=4))
    assert pairs == {(min(i, j), max(i, j)) for i in range(24) for j in ((i + 1) % 24, (i + 2) % 24)}
    assert len(promising_pairs(features[:5], 0.85)) == 10


def test_only_exact_distortion_models() -> None:
    assert opencv_distortion("SIMPLE_RADIAL", [500, 1, 2, 0.1]) == (0.1, 0, 0, 0, 0)
    assert opencv_distortion("OPENCV", [5, 5, 1, 2, 0.1, 0.2, 0.3, 0.4]) == (0.1, 0.2, 0.3, 0.4, 0)
    assert opencv_distortion("FULL_OPENCV", [5, 5, 1, 2, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0]) == (0.1, 0.2, 0.3, 0.4, 0.5)
    with pytest.raises(ValueError, match="FULL_OPENCV"):
        opencv_distortion("FULL_OPENCV", [0] * 11 + [1])


@pytest.mark.parametrize(("model", "params"), [
    ("SIMPLE_RADIAL", [500, 100, 90, -0.2]), ("OPENCV", [500, 510, 100, 90, -0.2, 0.1, 0.01, -0.02]),
])  # fmt: skip
def test_distortion_means_the_same_to_the_solver_and_to_us(model: str, params: list[float]) -> None:
    """Oracle: COLMAP's own projection."""
    pycolmap = pytest.importorskip("pycolmap")
    from pipeline.transforms import project

    camera = pycolmap.Camera(model=model, width=200, height=180, params=params)
    rays = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)) + [0, 0, 1]
    expected = np.array([camera.img_from_cam(r) for r in rays]).reshape(-1, 2)
    uv, _ = project(camera.calibration_matrix(), np.eye(4), np.array(opencv_distortion(model, params)), rays)
    np.testing.assert_allclose(uv, expected, atol=1e-9)
