"""What is asked of photos of people: head and neck, not the chest, and never nothing of a head that was lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.contract import execute
from pipeline.extent import HEAD_BELOW, HEAD_RADIUS, head_extent
from pipeline.faces.find import Face
from pipeline.faces.landmarks3d import head_frame, load_landmarks, photos_of_face
from pipeline.images import read_alpha
from pipeline.store import Store
from pipeline.transforms import inverse_rigid, matrix, project
from stages.masks import segment
from stages.masks.extent import BUST, asked, kept_whole, share_beyond
from stages.masks.judge import extent_finding
from stages.masks.segment import FaceResult, Masked
from stages.masks.stage import STAGE, Config
from tests.masks.test_masks_stage import Scene, ball_alpha, scene  # noqa: F401
from tests.support.faces import camera, face

F64 = np.typing.NDArray[np.float64]
EXTENT = head_extent(head_frame(face()), HEAD_BELOW, HEAD_RADIUS)


def shell(centre: tuple[float, float, float], radii: tuple[float, float, float], count: int = 40_000) -> F64:
    """(N, 3) on an ellipsoid, evenly."""
    k = np.arange(count)
    height = 1 - 2 * (k + 0.5) / count
    ring, angle = np.sqrt(1 - height**2), k * 2.399963
    return np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], 1) * radii + centre


HEAD, CHEST = shell((0, 0, -0.02), (0.09, 0.13, 0.1)), shell((0, -0.42, -0.03), (0.2, 0.27, 0.11))


def pixels(c: Camera, at: tuple[float, float, float]) -> tuple[int, int]:
    uv, _ = project(matrix(c.K), inverse_rigid(matrix(c.world_from_cam)), np.array(c.distortion), np.array([at]))
    return int(uv[0, 1]), int(uv[0, 0])


def test_a_piece_of_hull_before_a_detected_face_hides_nothing() -> None:
    c = camera(0, 0, -30, 1.6)
    alpha = np.zeros((c.height, c.width), np.float32)
    alpha[:, 100:540] = 1
    toward = matrix(c.world_from_cam)[:3, 3] / np.linalg.norm(matrix(c.world_from_cam)[:3, 3])
    piece = shell(tuple(0.3 * toward), (0.06, 0.06, 0.06))
    row, column = pixels(c, (0.0, 0.0, 0.07))
    for face_seen in (False, True):
        found = asked(c, alpha, EXTENT, np.concatenate([HEAD, CHEST, piece]), face_seen)
        assert found is not None and found[row, column] == face_seen
        low = pixels(c, (0.0, -0.38, 0.07))
        assert found[low] == 0


@pytest.mark.parametrize("azimuth", [0, 60, 180])
def test_the_chest_is_not_asked(azimuth: float) -> None:
    c = camera(0, azimuth, 10, 1.6)
    alpha = np.zeros((c.height, c.width), np.float32)
    alpha[:, 100:540] = 1
    found = asked(c, alpha, EXTENT, np.concatenate([HEAD, CHEST]))
    assert found is not None and found.shape == alpha.shape
    side = np.array([np.sin(np.radians(azimuth)), 0, np.cos(np.radians(azimuth))])
    assert (found[:, :100] == 1).all()  # background
    for y, is_asked in ((0.1, 1), (0.0, 1), (-0.1, 1), (-0.3, 0), (-0.36, 0)):
        row, column = pixels(c, tuple(np.array([0, y, -0.02]) + 0.09 * side))
        assert found[row, column] == is_asked, y


def test_a_shoulder_before_the_neck_hides_it() -> None:
    """Seen from below: the ray through the neck meets the chest first."""
    c = camera(0, 0, -50, 1.6)
    alpha = np.ones((c.height, c.width), np.float32)
    neck = pixels(c, (0, -0.13, 0.0))
    open_, hidden = (asked(c, alpha, EXTENT, np.concatenate(parts)) for parts in
                     ((HEAD, CHEST), (HEAD, CHEST, shell((0, -0.3, 0.2), (0.1, 0.1, 0.05)))))  # fmt: skip
    assert open_ is not None and hidden is not None
    assert open_[neck] == 1 and hidden[neck] == 0


def test_a_head_that_the_hull_has_lost_is_asked_all_the_same() -> None:
    c = camera(0, 0, 0, 1.6)
    alpha = np.zeros((c.height, c.width), np.float32)
    alpha[:, 200:440] = 1
    found = asked(c, alpha, EXTENT, CHEST)
    assert found is not None and found[pixels(c, (0, 0.05, 0.05))] == 1
    assert found[pixels(c, (0, -0.35, 0.05))] == 0


def test_nothing_is_left_out_of_a_head_alone() -> None:
    c = camera(0, 0, 0, 1.6)
    alpha = np.zeros((c.height, c.width), np.float32)
    row, column = pixels(c, (0, 0, 0))
    alpha[row - 45 : row + 45, column - 35 : column + 35] = 1
    assert asked(c, alpha, EXTENT, HEAD) is None


@pytest.mark.parametrize("method", ["key", "object"])
def test_the_stage_hands_on_face_and_extent(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str  # noqa: F811
) -> None:  # fmt: skip
    """A small face on a ball: what lies beyond its neck is not asked; an object with a face is one."""
    points = 0.35 * face() + (0, 0.05, 0.05)

    def look(m: Masked, *_: object) -> FaceResult:
        uv, _z = project(matrix(m.camera.K), inverse_rigid(matrix(m.camera.world_from_cam)), np.zeros(5), points)
        return FaceResult(Face(uv, 1.0) if m.view.index % 3 else None)

    real = segment.plan
    monkeypatch.setattr(segment, "_find_face", look)
    if method == "object":
        monkeypatch.setattr(segment, "plan", lambda *a: replace(real(*a), method="object"))
        monkeypatch.setattr(segment, "mask", lambda view, *_: (ball_alpha(view.camera), "object"))
    found = execute(STAGE, scene.inputs(), Config(hull_cells=32), Store(tmp_path / "store")).located
    assert found.artifact.landmarks is not None
    np.testing.assert_allclose(load_landmarks(found.path(found.artifact.landmarks)), points, atol=1e-6)
    held = {v.index for v in scene.views if v.holdout}
    fitted = {i for i in range(len(scene.views)) if i % 3 and i not in held | set(found.artifact.dropped)}
    assert set(photos_of_face(found.path(found.artifact.landmarks))) == fitted
    if method == "object":
        assert found.artifact.extent is None and all(m.asked is None for m in found.artifact.masks)
        assert "extent" not in [f.check for f in found.artifact.findings]
        return
    assert found.artifact.extent is not None
    (told,) = [f for f in found.artifact.findings if f.check == "extent"]
    assert told.level == "good" and "the upper shoulders" in told.said
    cut = [m for m in found.artifact.masks if m.asked is not None]
    assert len(cut) > 0.8 * len(found.artifact.masks)
    for m in cut:
        assert m.asked is not None
        part, alpha = read_alpha(found.path(m.asked)), read_alpha(found.path(m.mask))
        assert (part[alpha == 0] == 1).all() and (part[alpha == 1] < 0.5).any()


def test_photos_that_do_not_agree_on_a_head_are_told() -> None:
    assert extent_finding(0, 0, False) is None  # nobody in the photos, or only from behind
    lost = extent_finding(5, 0, False)
    assert lost is not None and lost.level == "usable" and "5 photos" in lost.said and lost.remedy
    whole = extent_finding(9, 8, False)
    assert whole is not None and whole.level == "good" and "8 photos" in whole.said and "everything" in whole.said


def test_what_a_thick_hull_puts_just_above_the_cut_is_not_asked() -> None:
    """Seen from above the body lies lower than the hull in front of it, by most of the way that the ray goes on."""
    front = shell((0, -0.19, -0.06), (0.1, 0.1, 0.1))
    level, above = (camera(0, 0, e, 1.6) for e in (0, 45))
    alpha = np.ones((level.height, level.width), np.float32)
    at = (0.0, -0.165, 0.037)  # 2 cm above the cut
    for c, wanted in ((level, 1), (above, 0)):
        found = asked(c, alpha, EXTENT, front)
        assert found is not None and found[pixels(c, at)] == pytest.approx(wanted, abs=0.3)


AROUND = [camera(i, 30 * i, 5, 2.4) for i in range(12)]


def outlines(points: F64) -> list[np.typing.NDArray[np.float32]]:
    """Masks of convex parts of 40,000 points each, seen by AROUND."""
    alphas = []
    for c in AROUND:
        uv, _ = project(matrix(c.K), inverse_rigid(matrix(c.world_from_cam)), np.array(c.distortion), points)
        alpha = np.zeros((c.height, c.width), np.uint8)
        for part in np.split(uv.astype(np.int32), len(uv) // 40_000):
            cv2.fillConvexPoly(alpha, cv2.convexHull(part), 1)
        alphas.append(alpha.astype(np.float32))
    return alphas


def test_how_much_goes_on_beyond_the_extent() -> None:
    """A head alone has nothing beyond it; with a chest as large as a person's more is beyond than inside."""
    assert share_beyond(AROUND, outlines(HEAD), EXTENT, 0.28) < 0.05
    assert share_beyond(AROUND, outlines(np.concatenate([HEAD, CHEST])), EXTENT, 0.28) > 1.3 > BUST


def test_a_bust_is_kept_whole() -> None:
    """A scan that ends in its shoulders, and not a seated person with a chest."""
    frame = head_frame(face())
    whole = {"scan": shell((0, -0.24, -0.03), (0.21, 0.09, 0.09)), "person": CHEST}
    found = {k: kept_whole(AROUND, outlines(np.concatenate([HEAD, v])), frame, 0.28) for k, v in whole.items()}
    assert found == {"scan": True, "person": False}


def test_a_gap_in_the_hull_does_not_take_a_piece_of_the_face() -> None:
    """Through it the back of a hull is seen that reaches far behind the head."""
    c = camera(0, 0, 0, 1.6)
    alpha = np.ones((c.height, c.width), np.float32)
    back = shell((0, 0.05, -0.3), (0.1, 0.1, 0.02))
    gap = HEAD[~((np.abs(HEAD[:, 0]) < 0.04) & (np.abs(HEAD[:, 1] - 0.03) < 0.04))]
    found = asked(c, alpha, EXTENT, np.concatenate([gap, back, CHEST]))
    assert found is not None and found[pixels(c, (0, 0.03, 0.07))] == 1
    assert found[pixels(c, (0, -0.35, 0.05))] == 0
