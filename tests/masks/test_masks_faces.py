"""Labels of face and eyes, on a real photo and on drawn ones."""

from __future__ import annotations

import numpy as np
import pytest
from skimage import data

from pipeline.faces.find import LEFT_EYE, RIGHT_EYE, Face
from stages.masks.face_labels import EYES, FACE, SUBJECT, face_labels, on_subject
from stages.masks.region import Disc

ASTRONAUT = data.astronaut()
SUBJECT_ALPHA = np.zeros((512, 512), np.float32)
SUBJECT_ALPHA[20:, 40:300] = 1


def test_labels_of_a_real_face() -> None:
    labels = face_labels(ASTRONAUT, SUBJECT_ALPHA, Disc(225, 110, 100, 0.0))
    assert labels is not None and labels.dtype == np.uint8 and set(np.unique(labels)) == {0, SUBJECT, FACE, EYES}
    for x, y in ((204, 101), (247, 103)):  # her pupils
        assert labels[y, x] == EYES
    for x, y in ((225, 130), (200, 130), (225, 75)):  # nose, cheek, forehead
        assert labels[y, x] == FACE
    for x, y in ((170, 70), (150, 400), (225, 195)):  # hair, suit, neck
        assert labels[y, x] == SUBJECT
    assert not labels[SUBJECT_ALPHA == 0].any()
    # eyes are a hundredth of a face or two
    assert 0.005 < (labels == EYES).sum() / (labels >= FACE).sum() < 0.04


def test_a_face_beside_the_subject_is_not_theirs() -> None:
    assert face_labels(ASTRONAUT, np.roll(SUBJECT_ALPHA, 260, 1), Disc(225, 110, 100, 0.0)) is None
    assert face_labels(np.zeros_like(ASTRONAUT), SUBJECT_ALPHA, Disc(225, 110, 100, 0.0)) is None


def test_labels_fill_the_outlines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ellipses: of two eyes in a face, half of which is beyond the subject."""
    points, turn = np.full((468, 2), 50.0), np.arange(16) / 16 * 2 * np.pi
    for eye, x in ((RIGHT_EYE, 30.0), (LEFT_EYE, 70.0)):
        points[list(eye)] = np.stack([x + 8 * np.cos(turn), 40 + 4 * np.sin(turn)], 1)
    turn = np.arange(36) / 36 * 2 * np.pi
    points[200:236] = np.stack([50 + 40 * np.cos(turn), 50 + 45 * np.sin(turn)], 1)
    monkeypatch.setattr("stages.masks.face_labels.find_face", lambda *_: Face(points, 1.0))
    alpha = np.ones((100, 100), np.float32)
    labels = face_labels(np.zeros((100, 100, 3), np.uint8), alpha, Disc(50, 50, 50, 0.0))
    assert labels is not None and (labels == EYES).sum() == pytest.approx(2 * np.pi * 8 * 4, rel=0.15)
    assert (labels >= FACE).sum() == pytest.approx(np.pi * 40 * 45, rel=0.05)
    rows, columns = np.nonzero(labels == EYES)
    assert rows.mean() == pytest.approx(39.5, abs=0.5) and columns.mean() == pytest.approx(49.5, abs=0.5)
    alpha[:, 60:] = 0
    points[:, 0] -= 0.01
    labels = face_labels(np.zeros((100, 100, 3), np.uint8), alpha, Disc(50, 50, 50, 0.0))
    assert labels is not None and (labels[:, :59] > 0).all() and not labels[:, 60:].any()
    assert (labels[:, 59] == SUBJECT).all()  # the mask's edge is no face yet


def test_points_beyond_the_frame_are_not_on_the_subject() -> None:
    face = Face(np.array([[1.0, 1.0], [200.0, 1.0], [1.0, -3.0], [99.9, 99.9]]), 1.0)
    assert on_subject(face, np.ones((100, 100), np.float32)) == 0.5
    assert on_subject(face, np.zeros((100, 100), np.float32)) == 0
