"""Landmarks that are wrong in half of the photos, or on half of the face: the head is placed right, or it is refused
with the figure."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.faces.landmarks3d import triangulate
from pipeline.registration.identity_fit import PlacedHead, placed_on_landmarks
from pipeline.template.load import load_template
from pipeline.transforms import inverse_rigid, matrix, project
from stages.template.judge import refused_faces, refused_placing
from tests.support.faces import camera

TEMPLATE = load_template()
SCALE = 1.1
CAMERAS = [
    camera(i, a, e) for i, (a, e) in enumerate((a, e) for e in (-15, 0, 15) for a in (-50, -30, -10, 10, 30, 50))
]
FACE_PIXELS = 110  # about the face's size in a photo


def truth() -> np.ndarray:
    """(468, 3) where the network's landmarks lie on an average head; those that the template does not have, near it."""
    out = np.random.default_rng(3).uniform(-0.05, 0.05, (468, 3)) + [0, 0, 0.08]
    out[TEMPLATE.landmarks.network] = TEMPLATE.landmark_points(TEMPLATE.vertices)
    return SCALE * out


def photographed(cameras: list[Camera]) -> np.ndarray:
    """(N, 468, 2) pixels, with the network's scatter."""
    uv = [project(matrix(c.K), inverse_rigid(matrix(c.world_from_cam)), np.array(c.distortion), truth())[0]
          for c in cameras]  # fmt: skip
    return np.stack(uv) + np.random.default_rng(0).normal(0, 0.8, (len(cameras), 468, 2))


def spoilt(kind: str, uv: np.ndarray, which: np.ndarray) -> np.ndarray:
    """The landmarks, wrong in the photos `which`, in each in its own way."""
    out, random = uv.copy(), np.random.default_rng(1)
    for n in which:
        if kind == "beside the face":
            turn = random.uniform(0, 2 * np.pi)
            out[n] += FACE_PIXELS * random.uniform(0.3, 1.0) * np.array([np.cos(turn), np.sin(turn)])
        elif kind == "of another size":
            out[n] = out[n].mean(0) + random.choice([0.5, 1.6]) * (out[n] - out[n].mean(0))
        elif kind == "upside down":
            out[n] = 2 * out[n].mean(0) - out[n] + random.normal(0, 5, 2)
        else:
            out[n] = random.uniform(0, 480, (468, 2))
    return out


def off_mm(head: PlacedHead) -> float:
    """Mean distance of the placed head's landmarks from the true ones, millimetres."""
    there = TEMPLATE.landmark_points(head.vertices) - SCALE * TEMPLATE.landmark_points(TEMPLATE.vertices)
    return 1000 * float(np.linalg.norm(there, axis=1).mean())


@pytest.mark.parametrize("kind", ["beside the face", "of another size", "upside down", "anywhere"])
def test_half_of_the_photos_are_wrong(kind: str) -> None:
    wrong = np.arange(0, len(CAMERAS), 2)
    found = triangulate(CAMERAS, spoilt(kind, photographed(CAMERAS), wrong))
    assert found is not None and not found.kept[wrong].any() and found.kept.sum() >= 8
    head = placed_on_landmarks(TEMPLATE, found.xyz)
    assert head is not None and off_mm(head) < 1.5
    assert not refused_placing(1000 * float(np.median(head.residual)), head.scale, metric=True)


@pytest.mark.parametrize("kind", ["beside the face", "anywhere"])
def test_too_few_right_photos_are_no_face(kind: str) -> None:
    right = 2
    wrong = np.arange(right, len(CAMERAS))
    found = triangulate(CAMERAS, spoilt(kind, photographed(CAMERAS), wrong))
    agree = 0 if found is None else int(found.kept.sum())
    if found is not None:  # three that agree by chance in one photo in ten or fewer are refused, with the figure
        head = placed_on_landmarks(TEMPLATE, found.xyz)
        why = refused_faces(agree, 40)
        assert "photos agree on a face" in why or head is None or off_mm(head) < 3
    assert agree <= 4


@pytest.mark.parametrize(("share", "placed"), [(0.5, True), (0.95, False)])
def test_half_of_the_landmarks_are_wrong(share: float, placed: bool) -> None:
    random = np.random.default_rng(2)
    points = truth() + random.normal(0, 0.001, (468, 3))
    wrong = random.permutation(468)[: int(share * 468)]
    points[wrong] += random.normal(0, 0.03, (len(wrong), 3))
    head = placed_on_landmarks(TEMPLATE, points)
    assert head is not None
    residual = 1000 * float(np.median(head.residual))
    why = refused_placing(residual, head.scale, metric=True)
    if placed:
        assert not why and off_mm(head) < 3
    else:
        assert f"{residual:.2g} mm off (median), more than 6" in why
