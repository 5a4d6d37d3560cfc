"""Faces in photos: a real one, at any size and turn, and pictures without any."""

from __future__ import annotations

import hashlib

import cv2
import numpy as np
import pytest
from skimage import data

from pipeline.faces.find import LEFT_EYE, MODELS, RIGHT_EYE, Face, find_face

ASTRONAUT = data.astronaut()
RIGHT, LEFT = np.array([203.6, 101.1]), np.array([246.8, 102.9])  # her pupils, read off the photo enlarged


def test_models_are_the_files_that_the_notice_names() -> None:
    said = [line.split()[1:] for line in (MODELS / "NOTICE").read_text().splitlines() if "sha256" in line]
    assert len(said) == 2
    for sha256, name in said:
        assert hashlib.sha256((MODELS / name).read_bytes()).hexdigest() == sha256


def test_a_face_and_its_pupils() -> None:
    face = find_face(ASTRONAUT, 256, 256, 256)
    assert face is not None and face.points.shape == (468, 2) and face.sure > 0.99
    right, left = face.pupils
    assert np.linalg.norm(right - RIGHT) < 2.5 and np.linalg.norm(left - LEFT) < 2.5
    around = cv2.convexHull(face.points.astype(np.float32))
    for eye in (RIGHT_EYE, LEFT_EYE):
        outline = face.points[list(eye)].astype(np.float32)
        assert 30 < cv2.contourArea(outline) < 300
        assert all(cv2.pointPolygonTest(around, tuple(map(float, p)), False) > 0 for p in outline)


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_a_turned_face(quarter: int) -> None:
    """The roll of the camera is told; rot90 turns anticlockwise, so that up leans to the left."""
    turned = np.ascontiguousarray(np.rot90(ASTRONAUT, quarter))
    face = find_face(turned, 256, 256, 256, -np.pi / 2 * quarter)
    assert face is not None
    for found, at in zip(face.pupils, (RIGHT, LEFT), strict=True):
        for _ in range(quarter):
            at = np.array([at[1], 512 - at[0]])
        assert np.linalg.norm(found - at) < 3


def test_a_face_in_a_large_photo_is_found_where_one_looks() -> None:
    large = np.zeros((1200, 1600, 3), np.uint8)
    large[600:1112, 1000:1512] = ASTRONAUT
    face = find_face(large, 1000 + 225, 600 + 110, 200)
    assert face is not None and np.linalg.norm(face.pupils[0] - RIGHT - (1000, 600)) < 2.5
    assert find_face(large, 300, 300, 250) is None


@pytest.mark.parametrize("picture", [data.coffee(), data.chelsea(), np.zeros((200, 300, 3), np.uint8)])
def test_no_face(picture: np.ndarray) -> None:
    h, w = picture.shape[:2]
    assert find_face(np.ascontiguousarray(picture), w / 2, h / 2, max(h, w) / 2) is None


def test_pupils_are_between_the_corners() -> None:
    points = np.zeros((468, 2))
    points[33], points[133], points[362], points[263] = (1, 2), (3, 4), (7, 2), (9, 2)
    right, left = Face(points, 1.0).pupils
    np.testing.assert_allclose([right, left], [(2, 3), (8, 2)])
