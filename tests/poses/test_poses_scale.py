"""Metric scale: known distances, markers drawn into photos, positions from EXIF; and each when it does not tell."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.errors import StageError, UsageError
from pipeline.faces.find import Face
from pipeline.template.load import load_template
from pipeline.transforms import F64, inverse_rigid, matrix, project, rows, similarity
from stages.poses.scale import (
    DICTIONARIES,
    Scale,
    by_distance,
    by_markers,
    by_positions,
    by_pupils,
    check_distance,
    eyes_of,
    find_markers,
)
from stages.poses.scale_source import HEAD_SIZE, landmarks_of, size_of_head
from tests.support.textured_ball import camera_on_orbit, write_facescape

SIZE = (640, 480)
K = np.array([[700.0, 0, 320.0], [0, 700.0, 240.0], [0, 0, 1]])
WORLD = 7.3  # units of the capture's world in a metre
POSES = [camera_on_orbit(a, 35.0, 0.6 * WORLD, np.zeros(3)) for a in (-40, -20, 0, 20, 40)]
CAMERAS = [
    Camera(index=i, name=f"{i}.jpg", width=640, height=480, K=rows(K), world_from_cam=rows(p),
           distortion=(-0.1, 0.02, 0, 0, 0)) for i, p in enumerate(POSES)
]  # fmt: skip


def seen(point: list[float], camera: Camera) -> F64:
    uv, _ = project(K, inverse_rigid(matrix(camera.world_from_cam)), np.array(camera.distortion), np.array([point]))
    return np.asarray(uv[0])


def at(point: list[float], *cameras: int) -> str:
    return "+".join("{}.jpg@{:.2f},{:.2f}".format(i, *seen(point, CAMERAS[i])) for i in cameras)


def test_two_cameras_a_known_distance_apart() -> None:
    apart = np.linalg.norm(POSES[0][:3, 3] - POSES[4][:3, 3]) / WORLD
    found = by_distance(f"0.jpg to 4 = {apart:.9f}", CAMERAS)
    assert found.metres_per_unit == pytest.approx(1 / WORLD, rel=1e-6) and "0.jpg to 4" in found.source


def test_two_points_seen_in_photos() -> None:
    a, b = [0.03 * WORLD, 0, 0], [-0.03 * WORLD, 0.01 * WORLD, 0]
    metres = float(np.linalg.norm(np.subtract(a, b))) / WORLD
    found = by_distance(f"{at(a, 0, 2, 4)} to {at(b, 1, 3)} = {metres:.9f}", CAMERAS)
    assert found.metres_per_unit == pytest.approx(1 / WORLD, rel=1e-3)  # pixels are written with two digits


@pytest.mark.parametrize(
    ("spec", "says"),
    [("0.jpg - 4.jpg = 0.4", "not understood"), ("0.jpg to 4.jpg = -1", "not understood"),
     ("0.jpg to 4.jpg = 0", "not understood"), ("0.jpg to 9.jpg = 1", "no camera"), ("0.jpg to 0 = 1", "same point"),
     ("0.jpg@1;2+1.jpg@2,3 to 1.jpg = 1", "point of the known distance is not"),
     ("0.jpg@300,200 to 1.jpg = 1", "do not meet"), ("0.jpg@300,200+4.jpg@10,400 to 1.jpg = 1", "do not meet"),
     ("0.jpg@300,200+0.jpg@300,200 to 1.jpg = 1", "do not meet")],
)  # fmt: skip
def test_distances_that_say_nothing(spec: str, says: str) -> None:
    with pytest.raises((UsageError, StageError), match=says):
        by_distance(check_distance(spec), CAMERAS)


def photo_of_markers(camera: Camera, kind: str, edge: float, numbers: tuple[int, ...] = (3, 7)) -> np.ndarray:
    """Markers flat on the ground, drawn by the homography of each (a lens without distortion)."""
    out = np.full((SIZE[1], SIZE[0]), 200, np.uint8)
    for k, number in enumerate(numbers):
        picture = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(DICTIONARIES[kind]), number, 200)
        x = edge * (1.5 * k - 1.2)
        ground = np.array([[x, 0, -edge / 2], [x + edge, 0, -edge / 2], [x + edge, 0, edge / 2], [x, 0, edge / 2]])
        uv, _ = project(K, inverse_rigid(matrix(camera.world_from_cam)), np.zeros(5), ground)
        corners = np.array([[0, 0], [200, 0], [200, 200], [0, 200]], np.float32)
        H = cv2.getPerspectiveTransform(corners - 0.5, (uv - 0.5).astype(np.float32))
        out = np.minimum(out, cv2.warpPerspective(picture, H, SIZE, flags=cv2.INTER_LINEAR, borderValue=200))
    return cv2.GaussianBlur(out, (0, 0), 0.7)


@pytest.mark.parametrize("kind", ["aruco_4x4", "apriltag_36h11"])
def test_markers_of_a_known_size(kind: str) -> None:
    flat = [c.model_copy(update={"distortion": (0.0,) * 5}) for c in CAMERAS]
    found = [(c, find_markers(photo_of_markers(c, kind, 0.05 * WORLD), kind)) for c in flat]
    assert all(set(f) == {3, 7} for _, f in found)
    scale = by_markers(found, 0.05)
    assert scale is not None and scale.metres_per_unit == pytest.approx(1 / WORLD, rel=2e-3)
    assert "2 markers of 50 mm (numbers 3, 7)" in scale.source
    assert by_markers(found[:1], 0.05) is None  # one photo sees no depth
    wrong = [(c, {3: f[3] + [[40, 0], [0, 0], [0, 0], [0, 0]]}) for c, f in found]
    assert by_markers(wrong, 0.05) is None  # no square
    assert find_markers(photo_of_markers(flat[0], kind, 0.05 * WORLD, (3, 3)), kind) == {}  # which is which?


def pupils(observed: list) -> Scale | None:
    eyes = eyes_of(observed)
    return None if eyes is None else by_pupils(eyes, 0.063)


def test_pupils_seen_in_photos() -> None:
    rng = np.random.default_rng(0)
    eyes = [[-0.0315 * WORLD, 0.02, 0.08], [0.0315 * WORLD, 0.02, 0.08]]
    observed = [(c, (seen(eyes[0], c) + rng.normal(size=2), seen(eyes[1], c) + rng.normal(size=2))) for c in CAMERAS]
    found = pupils(observed)
    assert found is not None and found.metres_per_unit == pytest.approx(1 / WORLD, rel=0.03)
    assert "63 mm between the pupils, seen in 5 photos" in found.source
    swapped = [*observed[:4], (observed[4][0], (observed[4][1][0] + 90, observed[4][1][1] - 90))]  # another face
    found = pupils(swapped)
    assert found is not None and found.metres_per_unit == pytest.approx(1 / WORLD, rel=0.03)
    assert "seen in 4 photos" in found.source and pupils(swapped[2:]) is None
    assert pupils(observed[:2]) is None
    assert pupils([observed[0]] * 4) is None  # one view sees no depth


def test_positions_tell_where_they_are_spread_wider_than_wrong() -> None:
    turn = cv2.Rodrigues(np.array([0.3, -1.0, 0.4]))[0]
    rng = np.random.default_rng(0)
    ring = [camera_on_orbit(a, 10, 30.0, np.zeros(3)) for a in range(0, 360, 20)]
    cameras = [CAMERAS[0].model_copy(update={"index": i, "world_from_cam": rows(p)}) for i, p in enumerate(ring)]

    def places(noise: float, radius: float) -> dict[int, tuple[float, float, float]]:
        return {i: tuple(turn @ p[:3, 3] * radius / 30 + rng.normal(size=3) * noise) for i, p in enumerate(ring)}

    found, _ = by_positions(cameras, places(1.0, 20.0))
    assert found is not None and found.metres_per_unit == pytest.approx(20 / 30, rel=0.05)
    assert "18 photos" in found.source
    none, why = by_positions(cameras, places(3.0, 1.0))
    assert none is None and "an error of" in why
    none, why = by_positions(cameras[:4], places(0.1, 20.0))
    assert none is None and "only 4 photos" in why


def test_the_stage_says_where_the_scale_is_from(tmp_path: Path, capture_of, place) -> None:
    write_facescape(tmp_path / "c", POSES, K, SIZE, pictures=False)
    for i, c in enumerate(CAMERAS):
        flat = c.model_copy(update={"distortion": (0.0,) * 5})
        cv2.imwrite(str(tmp_path / "c" / f"{i}.jpg"), photo_of_markers(flat, "aruco_4x4", 0.05 * WORLD))
    capture = capture_of(tmp_path / "c", drop_blurred=False)
    given = {"check": False, "unit": "unknown"}
    found = place(capture, marker_mm=50, **given).artifact
    assert found.metric and found.scale.startswith("from 2 markers")
    centres = np.stack([matrix(c.world_from_cam)[:3, 3] for c in found.cameras])
    assert np.linalg.norm(centres[4] - centres[0]) == pytest.approx(2 * 0.6 * np.sin(np.radians(40))
                                                                    * np.cos(np.radians(35)), rel=5e-3)  # fmt: skip
    found = place(capture, distance="0.jpg to 4.jpg = 5.0", marker_mm=50, **given).artifact  # what is said goes first
    assert found.metric and "known distance of 5 m" in found.scale and "a head has" in found.warnings[-1]
    found = place(capture, marker_mm=50, marker_kind="apriltag_16h5", **given).artifact
    assert not found.metric and found.scale.startswith("unknown") and "0 markers of" in found.warnings[0]
    found = place(capture, pupils_mm=63, **given).artifact  # no face anywhere
    assert not found.metric and "agree on a face" in found.warnings[0]
    for asked in ("gps", "pupils", "markers"):
        with pytest.raises(StageError, match="scale can't be determined"):
            place(capture, scale=asked, **given)
    with pytest.raises(UsageError, match="not understood"):
        place(capture, distance="a lot", **given)


def test_the_published_scale_dictionary(tmp_path: Path, capture_of, place) -> None:
    """A world with Z up and an odd unit, whose dictionary makes it millimetres, upright, the face along +Z."""
    turn = cv2.Rodrigues(np.array([np.pi / 2, 0, 0]))[0]  # world from upright axes
    shift = np.array([0.4, -1.0, 2.0]) * WORLD
    folder = tmp_path / "tree" / "17" / "4_anger"
    moved = [similarity(1.0, turn, shift) @ p for p in POSES]
    write_facescape(folder, moved, K, SIZE, pictures=False)
    mm = 1e3 / WORLD
    Rt = np.concatenate([turn.T, (-turn.T @ shift * mm)[:, None]], 1)
    table = tmp_path / "tree" / "Rt_scale_dict.json"
    table.write_text(json.dumps({"17": {"4": [mm, Rt.tolist()], "1": [1.0, Rt.tolist()]}}))
    capture = capture_of(folder, drop_blurred=False)
    np.testing.assert_allclose(matrix(capture.artifact.metres_from_world) @ moved[2] @ [0, 0, 0, 1],
                               [*POSES[2][:3, 3] / WORLD, 1], atol=1e-9)  # fmt: skip
    found = place(capture, check=False).artifact
    assert found.metric and found.scale == "from FaceScape's scale dictionary" and found.warnings == ()
    assert matrix(found.cameras[2].world_from_cam)[:3, 3] == pytest.approx(POSES[2][:3, 3] / WORLD, abs=1e-6)
    source = place(capture, check=False, unit="metres").artifact  # what is said goes first
    assert source.scale.startswith("metres")
    for entry, says in (([0.0, Rt.tolist()], "no scale"), ([mm], "not understood"), ([mm, [[1]]], "wrong shape")):
        table.write_text(json.dumps({"17": {"4": entry}}))
        with pytest.raises(StageError, match=says):
            capture_of(folder, drop_blurred=False)
    for other in ({"17": {"1": [1, Rt.tolist()]}}, {"9": {}}, []):
        table.write_text(json.dumps(other))
        assert capture_of(folder, drop_blurred=False).artifact.metres_from_world is None


def test_the_size_of_a_head_is_guessed_from_its_landmarks() -> None:
    """The template's own landmarks, in a world of another unit: the guess is the size of the head times its ratio."""
    template = load_template()
    K = rows(np.array([[900.0, 0, 320], [0, 900, 320], [0, 0, 1]]))
    cams = [
        Camera(index=i, name=f"{i}", width=640, height=640, K=K, distortion=(0.0,) * 5,
               world_from_cam=rows(camera_on_orbit(azimuth, 5.0, 2.5, np.zeros(3))))
        for i, azimuth in enumerate((-25.0, 0.0, 25.0))
    ]  # fmt: skip
    marks = np.full((468, 3), np.nan)
    marks[template.landmarks.network] = template.landmark_points(template.vertices)
    others = np.flatnonzero(np.isnan(marks).any(1))  # no template's landmarks, but the network has them
    marks[others] = marks[np.resize(template.landmarks.network, len(others))]
    unit = 2.5
    world = unit * (marks - marks.mean(0))
    faces = []
    for c in cams:
        uv, _ = project(matrix(c.K), inverse_rigid(matrix(c.world_from_cam)), np.zeros(5), world)
        faces.append((c, Face(uv, 1.0)))
    found = size_of_head(landmarks_of(faces))
    assert found is not None and found.metres_per_unit == pytest.approx(HEAD_SIZE / unit, rel=0.02)
    assert "guessed" in found.source and size_of_head(landmarks_of([])) is None and landmarks_of(faces[:2]) is None


def test_the_error_of_positions_is_without_bias() -> None:
    """A similarity has seven free numbers, which so few positions partly take up: the mean of the squares told is 3
    sigma^2 all the same."""
    rng, sigma = np.random.default_rng(3), 0.12
    ring = [camera_on_orbit(a, 10, 1.0, np.zeros(3)) for a in range(0, 360, 60)]
    cameras = [CAMERAS[0].model_copy(update={"index": i, "world_from_cam": rows(p)}) for i, p in enumerate(ring)]
    told = []
    for _ in range(300):
        scale, why = by_positions(
            cameras, {i: tuple(p[:3, 3] + sigma * rng.normal(size=3)) for i, p in enumerate(ring)}
        )
        said = re.search(r"an error of (\S+) m", why if scale is None else scale.source)
        assert said is not None
        told.append(float(said[1]) ** 2)
    assert np.mean(told) == pytest.approx(3 * sigma**2, rel=0.1)


@pytest.mark.parametrize("kind", ["aruco_4x4", "apriltag_36h11"])
def test_corners_of_a_marker_are_where_its_edges_are(kind: str) -> None:
    """Of pixels 100 to 199, the first of which begins at 100.0: a pixel's centre is at a half."""
    picture = np.full((300, 300), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[kind])
    picture[100:200, 100:200] = cv2.aruco.generateImageMarker(dictionary, 7, 100)
    (corners,) = find_markers(cv2.GaussianBlur(picture, (0, 0), 0.8), kind).values()
    wanted = np.array([[100.0, 100], [200, 100], [200, 200], [100, 200]])
    apart = np.linalg.norm(corners[:, None] - wanted[None], axis=2).min(1)
    assert apart.max() < 0.25, corners
