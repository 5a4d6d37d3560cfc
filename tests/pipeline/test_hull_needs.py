"""Which part of a hull is the subject: by the masks that need it, and by the frames that have it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.hull import Hull, visual_hull
from pipeline.hull_needs import LEAST, is_subject, masks_in_need, regions, voxels_at
from tests.support.two_balls import HEAD, TORSO, WIDTH, bust_alpha, cropped_bust, ring_camera

CAMERAS = [ring_camera(i, 24) for i in range(24)]
ALPHAS = [bust_alpha(c) for c in CAMERAS]
EDGE, CELL = 0.29, 0.58 / 64


def carved() -> Hull:
    return visual_hull(CAMERAS, ALPHAS, [-EDGE] * 3, [EDGE] * 3, CELL)


def near(hull: Hull, ball: tuple[tuple[float, float, float], float], share: float) -> np.ndarray:
    """Voxels inside the hull within a share of a ball's radius."""
    centres = hull.centres(np.ones(hull.level.shape, bool)).reshape(*hull.level.shape, 3)
    return (np.linalg.norm(centres - ball[0], axis=-1) < share * ball[1]) & (hull.level <= 0)


def test_voxels_at_pixels_by_the_camera_matrix() -> None:
    hull, camera = carved(), CAMERAS[5]
    where = np.zeros((80, 80), bool)  # half of the photo's size
    where[20:45, 30:50] = True
    found = voxels_at(hull, camera, where)
    inside = np.argwhere(hull.level <= 0)
    x = (hull.lo + (inside + 0.5) * hull.cell) @ np.linalg.inv(np.array(camera.world_from_cam))[:3, :3].T
    x += np.linalg.inv(np.array(camera.world_from_cam))[:3, 3]
    u, v = ((x @ np.array(camera.K).T)[:, :2] / x[:, 2:]).T
    expected = (u >= 60) & (u < 100) & (v >= 40) & (v < 90)
    assert (found[tuple(inside.T)] == expected).all() and found.sum() == expected.sum() > 100
    behind = replace(hull, lo=hull.lo + 3 * np.array(camera.world_from_cam)[:3, 3])  # behind the camera
    assert not voxels_at(behind, camera, np.ones((80, 80), bool)).any()


def test_every_mask_needs_the_head_and_none_the_middle_of_the_torso() -> None:
    hull = carved()
    assert list(masks_in_need(hull, near(hull, HEAD, 2.0), CAMERAS, ALPHAS)) == list(range(24))
    assert list(masks_in_need(hull, near(hull, TORSO, 0.5), CAMERAS, ALPHAS)) == []
    assert list(masks_in_need(hull, np.zeros_like(hull.occupied), CAMERAS, ALPHAS)) == []
    assert list(masks_in_need(hull, hull.level <= 0, CAMERAS, ALPHAS)) == list(range(24))  # nothing is left


def test_a_mask_that_lacks_the_part_does_not_need_it() -> None:
    hull, head = carved(), near(carved(), HEAD, 1.0)
    small = [
        np.where((np.arange(WIDTH) < 100)[:, None], np.float32(0), a) if i < 20 else a for i, a in enumerate(ALPHAS)
    ]
    assert list(masks_in_need(hull, head, CAMERAS, small)) == [20, 21, 22, 23]


def test_a_part_that_most_frames_lack_must_be_needed() -> None:
    """How deep a torso is that only views from the front show: nothing needs the rear of its hull."""
    cameras, alphas = cropped_bust()
    hull = visual_hull(cameras, alphas, [-EDGE] * 3, [EDGE] * 3, CELL, max_outside=2, outside_share=0.1)
    centres = hull.centres(np.ones(hull.level.shape, bool)).reshape(*hull.level.shape, 3)
    rear = (hull.level <= 0) & (centres[..., 2] < -0.15) & (centres[..., 1] < -0.1)
    assert rear.sum() > 200 and not is_subject(hull, rear, cameras, alphas)
    front = (hull.level <= 0) & (centres[..., 1] < -0.1)  # all of the torso
    assert is_subject(hull, front, cameras, alphas)
    everywhere = replace(hull, seen=np.full_like(hull.seen, len(cameras)))
    assert is_subject(everywhere, rear, cameras, alphas)
    assert not is_subject(everywhere, np.zeros_like(rear), cameras, alphas)


def test_small_regions_are_noise() -> None:
    spots = np.zeros((50, 50), bool)
    spots[3:5, 3:5] = spots[20:30, 20:30] = True
    assert [int(r.sum()) for r in regions(spots, 4)] == [100] and len(regions(spots, 3)) == 2
    assert regions(np.zeros((5, 5), bool), 0) == []
    assert pytest.approx(0.01) == LEAST
