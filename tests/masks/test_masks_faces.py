"""Labels of face, eyes and hair, on a real photo and on drawn ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from skimage import data

from pipeline.faces.find import LEFT_EYE, RIGHT_EYE, Face
from pipeline.faces.labels import EYES, FACE, HAIR, LABELS, SUBJECT
from stages.masks.face_labels import labels_with, on_subject, subjects_face
from stages.masks.region import Disc
from stages.masks.user_model import UserModel
from tests.masks.test_masks_user_model import write_network, write_red_detector

ASTRONAUT = data.astronaut()
SUBJECT_ALPHA = np.zeros((512, 512), np.float32)
SUBJECT_ALPHA[20:, 40:300] = 1


def face_labels(image: np.ndarray, alpha: np.ndarray, disc: Disc, hair: UserModel | None = None) -> np.ndarray | None:
    return labels_with(subjects_face(image, alpha, disc), image, alpha, disc, hair)


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


@pytest.mark.parametrize("roll", [0.0, 0.7, np.pi])
def test_hair_is_what_the_users_network_says(tmp_path: Path, roll: float) -> None:
    """Red is hair to this network, and it sees the person upright, however the photo was held."""
    y, x = np.mgrid[0:240, 0:300]
    red = np.hypot(x + 0.5 - 180 - 40 * np.sin(roll), y + 0.5 - 130 + 40 * np.cos(roll)) < 25
    image = np.where(red[..., None], [220, 40, 40], [40, 220, 100]).astype(np.uint8)
    alpha = np.ones((240, 300), np.float32)
    alpha[:, :150] = 0
    seen = []

    class Watched(UserModel):
        def probability(self, square: np.ndarray) -> np.ndarray:
            seen.append(square)
            return super().probability(square)

    model = Watched(write_red_detector(tmp_path / "net.onnx", 64), 64, False, setting="masks.hair_model")
    labels = face_labels(image, alpha, Disc(180, 130, 70, roll), model)
    truth = red & (alpha > 0)
    assert labels is not None and set(np.unique(labels)) == {0, SUBJECT, HAIR}  # no face is seen
    assert ((labels == HAIR) & truth).sum() / ((labels == HAIR) | truth).sum() > 0.93
    rows = np.nonzero(seen[0][..., 0].astype(int) - seen[0][..., 1] > 90)[0]
    assert rows.mean() < 24  # above the middle
    assert face_labels(np.full_like(image, 90), alpha, Disc(180, 130, 70, roll), model) is None


def test_hair_covers_the_face_and_not_the_eyes(tmp_path: Path) -> None:
    everything = UserModel(write_network(tmp_path / "net.onnx", 64, [(50.0, 50.0, 50.0)]), 64, False)
    plain = face_labels(ASTRONAUT, SUBJECT_ALPHA, Disc(225, 110, 100, 0.0))
    labels = face_labels(ASTRONAUT, SUBJECT_ALPHA, Disc(225, 110, 100, 0.0), everything)
    assert labels is not None and plain is not None
    assert ((labels == EYES) == (plain == EYES)).all() and not (labels == FACE).any()
    assert labels[75, 225] == HAIR and labels[400, 200] == SUBJECT  # beyond what the network sees
    assert not labels[SUBJECT_ALPHA == 0].any() and LABELS[HAIR] == "hair"


def test_points_beyond_the_frame_are_not_on_the_subject() -> None:
    face = Face(np.array([[1.0, 1.0], [200.0, 1.0], [1.0, -3.0], [99.9, 99.9]]), 1.0)
    assert on_subject(face, np.ones((100, 100), np.float32)) == 0.5
    assert on_subject(face, np.zeros((100, 100), np.float32)) == 0
