"""Landmarks in space: made-up faces seen by made-up cameras, some of which see something else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.faces.landmarks3d import head_frame, off_frame, triangulate
from pipeline.transforms import F64, inverse_rigid, matrix, project
from tests.support.faces import SIZE, camera, face


def seen(cameras: Sequence[Camera], points: F64, noise: float = 0.0, seed: int = 0) -> F64:
    random = np.random.default_rng(seed)
    out = [project(matrix(c.K), inverse_rigid(matrix(c.world_from_cam)), np.array(c.distortion), points)[0]
           for c in cameras]  # fmt: skip
    return np.stack(out) + random.normal(0, noise, (len(cameras), len(points), 2))


CAMERAS = [camera(i, a, e) for i, (a, e) in enumerate((a, e) for e in (-15, 0, 20) for a in (-50, -25, 0, 25, 50))]


def test_exact_sightings_give_the_face_back() -> None:
    found = triangulate(CAMERAS, seen(CAMERAS, face()))
    assert found is not None and found.kept.all()
    np.testing.assert_allclose(found.xyz, face(), atol=1e-7)
    assert found.error_px.max() < 1e-3


def test_noise_and_photos_of_something_else() -> None:
    """A picture on the wall, seen consistently by a few photos, a face seen upside down, and one at random."""
    uv = seen(CAMERAS, face(), noise=1.0)
    poster = [1, 6, 11]
    uv[poster] = seen([CAMERAS[i] for i in poster], face() * 1.3 + (0.3, 0.1, -0.5))
    uv[4] = uv[4].mean(0) - (uv[4] - uv[4].mean(0))
    uv[13] = np.random.default_rng(5).uniform(0, 400, (468, 2))
    found = triangulate(CAMERAS, uv)
    assert found is not None
    assert set(np.flatnonzero(~found.kept)) == {*poster, 4, 13}
    error = np.linalg.norm(found.xyz - face(), axis=1)
    assert np.median(error) < 0.0012 and error.max() < 0.005


def test_landmarks_that_slide_are_given_less_weight() -> None:
    """Side views guess the far cheek: a third of the landmarks lie up to an eighth of the face off there."""
    uv = seen(CAMERAS, face(), noise=0.3)
    far = np.arange(468) % 3 == 0
    for n in (0, 5, 10):
        uv[n][far] += (20, 0)
    found = triangulate(CAMERAS, uv)
    assert found is not None and found.kept.all()
    assert np.median(np.linalg.norm(found.xyz - face(), axis=1)[far]) < 0.0008  # without weights 9.9 mm


def test_nothing_to_agree_on() -> None:
    assert triangulate(CAMERAS[:2], seen(CAMERAS[:2], face())) is None
    random = np.random.default_rng(1)
    assert triangulate(CAMERAS, random.uniform(0, 480, (len(CAMERAS), 468, 2))) is None
    together = [camera(i, 0.3 * i) for i in range(5)]  # a degree and a half: no depth
    assert triangulate(together, seen(together, face(), noise=0.5)) is None


@pytest.mark.parametrize("degrees", [0.0, 8.0, 45.0, 170.0])
def test_the_heads_axes(degrees: float) -> None:
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    frame = head_frame(face() @ turn.T + (1, 2, 3))
    np.testing.assert_allclose(frame.axes, turn.T, atol=1e-9)
    assert frame.height == pytest.approx(0.95 * SIZE)
    assert off_frame(frame) == pytest.approx(degrees, abs=1e-6)
    assert off_frame(frame, turn.T) == pytest.approx(0, abs=1e-4)
