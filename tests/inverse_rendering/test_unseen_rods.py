"""Rods behind a subject that no photo looks at: a ball with a rod at its back and one at its side."""

from __future__ import annotations

import numpy as np
import pytest

from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.unseen_rods import without_unseen_rods

CELL, COUNT, SIDE = 0.008, 64, 120
LO = np.full(3, -0.252, np.float32)
NODE = np.stack(np.meshgrid(*(LO[a] + CELL * np.arange(COUNT) for a in range(3)), indexing="ij"), -1)
RADIUS, THIN, THICK = 0.03, 0.02, 0.05
BALL = np.linalg.norm(NODE, axis=-1) - 0.12


def rod(direction: list[float], radius: float) -> np.ndarray:
    """From the middle to .22 m along a unit direction."""
    axis = np.array(direction)
    along = (NODE @ axis).clip(0, 0.2)
    return np.linalg.norm(NODE - along[..., None] * axis, axis=-1) - radius


BEHIND, BESIDE = [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]
AT = {"behind": (31, 31, 7), "beside": (55, 31, 31)}  # nodes at .18 to .2 m in the rods


def start(*parts: np.ndarray) -> Start:
    return Start(np.min([BALL, *parts], axis=0).astype(np.float32), LO, CELL)


def view(x: float, alpha: float = 1.0) -> PhotoView:
    """From the front, z = 1, towards the middle; everything is subject."""
    pose = np.eye(4)
    away = np.array([x, 0.0, 1.0])
    ahead = -away / np.linalg.norm(away)
    right = np.cross([0.0, -1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(ahead, right), ahead], 1), away
    K = np.array([[150.0, 0, SIDE / 2], [0, 150.0, SIDE / 2], [0, 0, 1]])
    return PhotoView(
        0, np.ones((SIDE, SIDE, 3), np.float32), np.full((SIDE, SIDE), alpha, np.float32), K, pose, np.zeros(5)
    )


FRONT = [view(x) for x in (-0.2, 0.0, 0.2)]


def inside(s: Start, name: str) -> bool:
    return bool(s.values[AT[name]] < 0)


def test_a_rod_behind_goes_and_one_that_photos_see_stays() -> None:
    before = start(rod(BEHIND, THIN), rod(BESIDE, THIN))
    assert inside(before, "behind") and inside(before, "beside")
    found = without_unseen_rods(before, FRONT, RADIUS)
    assert not inside(found, "behind") and inside(found, "beside")
    near = np.abs(BALL) < 0.5 * CELL
    front = near & (NODE[..., 2] > 0) & (NODE[..., 0] < 0.08)
    np.testing.assert_allclose(found.values[front], before.values[front], atol=0.2 * CELL)
    back = near & (NODE[..., 2] < -0.08) & (np.hypot(NODE[..., 0], NODE[..., 1]) > 0.06)
    assert np.abs(found.values[back] - before.values[back]).max() < CELL, "the ball's own back stays"


def test_what_is_thicker_than_the_radius_stays() -> None:
    before = start(rod(BEHIND, THICK))
    found = without_unseen_rods(before, FRONT, RADIUS)
    assert inside(found, "behind")


def test_a_photo_from_behind_keeps_the_rod() -> None:
    behind = view(0.0)
    pose = behind.world_from_cam.copy()
    turn = np.diag([-1.0, 1.0, -1.0])
    pose[:3, :3], pose[:3, 3] = turn @ pose[:3, :3], [0.3, 0.0, -1.0]
    pose[:3, :3] = turn @ view(-0.3).world_from_cam[:3, :3]
    around = PhotoView(1, behind.rgb, behind.alpha, behind.K, pose, behind.distortion)
    before = start(rod(BEHIND, THIN))
    assert inside(without_unseen_rods(before, [*FRONT, around], RADIUS), "behind")
    empty = PhotoView(1, behind.rgb, 0 * behind.alpha, behind.K, pose, behind.distortion)
    assert not inside(without_unseen_rods(before, [*FRONT, empty], RADIUS), "behind"), "its mask does not show it"


@pytest.mark.parametrize("radius", [0.0, 1e-6, 10.0])
def test_extreme_radii_leave_what_is_seen(radius: float) -> None:
    before = start()
    found = without_unseen_rods(before, FRONT, radius)
    assert np.isfinite(found.values).all()
    if radius < 1:
        assert found is before, "nothing is that thin"
    else:
        assert (found.values < 0).sum() == (before.values < 0).sum(), "all of it is within the radius of a seen place"


def test_without_photos_or_surface() -> None:
    empty = Start(np.ones_like(BALL, np.float32), LO, CELL)
    assert without_unseen_rods(empty, FRONT, RADIUS) is empty
    found = without_unseen_rods(start(rod(BEHIND, THIN)), [], RADIUS)
    assert not inside(found, "behind") and (found.values < 0).any()
