"""The cameras and the photos of a made-up phone (benchmarks.made_person.phone)."""

from __future__ import annotations

import numpy as np

from benchmarks.made_person.phone import ARCS, SIZE, developed, photos
from pipeline.transforms import project


def test_each_photo_looks_at_the_head_from_its_arc() -> None:
    views = photos(np.random.default_rng(0))
    assert len(views) == sum(count for count, _, _ in ARCS)
    for view in views.values():
        R, t = np.split(np.array(view["Rt"]), [3], axis=1)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0 and R[1, 1] < 0  # upright: down in the photo is down in the room
        centre = -R.T @ t[:, 0]
        assert 0.55 < np.linalg.norm(centre) < 1.0
        uv, z = project(np.array(view["K"]), np.vstack([view["Rt"], [0, 0, 0, 1]]), np.zeros(5), np.zeros((1, 3)))
        assert z[0] > 0 and np.abs(uv[0] - np.array(SIZE) / 2).max() < 120
        moved = np.array(view["head"])
        assert np.abs(moved[:3, 3]).max() < 0.01 and np.trace(moved[:3, :3]) > 2.999


def test_a_photo_keeps_the_order_of_brightness_and_clips_white() -> None:
    """Tone curve and vignetting are monotone in the light; noise is averaged out."""
    steps = np.geomspace(0.01, 4, 12)
    level = [developed(np.full((64, 48, 3), s), np.random.default_rng(1))[24:40, 16:32].mean() for s in steps]
    assert (np.diff(level) >= 0).all() and level[0] < 60 and level[-1] > 250
    for extreme, value in ((0.0, 0), (1e6, 255)):
        assert abs(int(np.median(developed(np.full((64, 48, 3), extreme), np.random.default_rng(1)))) - value) < 12
