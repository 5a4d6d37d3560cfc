"""Fitted eyes in the template: balls with corneas, and lids that end inside of them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.eyes.ball import CORNEA, IRIS, Eye, cornea_height, turned
from pipeline.eyes.place import SUNK, eye_displacement, eye_rows, with_eyes
from pipeline.registration.followers import room
from pipeline.registration.head import limit_surface
from pipeline.registration.subdivision import subdivided
from pipeline.template.load import load_template
from tests.support.eyes import gaze_to

TEMPLATE = load_template()
PART = "eye_left"
OWN = TEMPLATE.part_vertices(PART)
MIDDLE = 0.5 * (TEMPLATE.vertices[OWN].min(0) + TEMPLATE.vertices[OWN].max(0))
EYE = Eye(MIDDLE + [0, 0, 0.0025], 0.0125, turned(np.eye(3), gaze_to(7, -4)), 0.006)


def placed(levels: int, lids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the eye's subdivided and displaced vertices, and their angles from the gaze."""
    vertices = with_eyes(TEMPLATE, TEMPLATE.vertices, TEMPLATE.vertices, {PART: EYE})
    level = subdivided(TEMPLATE.quads, len(vertices), levels)
    points, normals, _ = limit_surface(vertices, level)
    own = eye_rows(level, TEMPLATE.parts[PART], levels)
    moved = eye_displacement(points, normals, own, lids, EYE, 1.0)
    assert np.abs(moved).max() < 0.0025
    at = points[own] + moved[:, None] * normals[own]
    return at, np.arccos(np.clip(EYE.local(at)[:, 2], -1, 1))


@pytest.mark.parametrize("levels", [1, 2])
def test_the_displaced_eye_is_a_ball_with_a_cornea(levels: int) -> None:
    at, angle = placed(levels, np.zeros((0, 3)))
    wanted = EYE.radius + cornea_height(angle, EYE.radius, EYE.iris, CORNEA / IRIS * EYE.iris)
    np.testing.assert_allclose(np.linalg.norm(at - EYE.centre, axis=1), wanted, atol=5e-5)
    assert wanted.max() > EYE.radius + 7e-4


def test_a_lid_before_the_iris_leaves_the_cornea_less_room() -> None:
    near = EYE.points(np.array([[0.0, 0.0, 1.0]])) + 3e-4 * EYE.axes[2]
    flat, _ = placed(2, near)
    away = np.linalg.norm(flat - EYE.centre, axis=1) - EYE.radius
    assert 1.5e-4 < away.max() < 3e-4
    full, _ = placed(2, EYE.points(np.array([[0.0, 0.0, -1.0]])) * 1.001)
    assert (np.linalg.norm(full - EYE.centre, axis=1) - EYE.radius).max() > 7e-4


def test_the_template_s_pole_looks_along_the_gaze() -> None:
    vertices = with_eyes(TEMPLATE, TEMPLATE.vertices, TEMPLATE.vertices, {PART: EYE})
    before = TEMPLATE.vertices[OWN] - MIDDLE
    np.testing.assert_allclose(
        EYE.local(vertices[OWN]), before / np.linalg.norm(before, axis=1, keepdims=True), atol=1e-9
    )


def test_edges_that_were_sunk_stay_sunk_and_nothing_else_moves() -> None:
    rest, skin = TEMPLATE.vertices, TEMPLATE.part_vertices("skin")
    small = Eye(MIDDLE + [0, 0, 0.001], 0.0125, np.eye(3), 0.006)
    made = with_eyes(TEMPLATE, rest, rest, {PART: small})
    sunk = room(rest[OWN], rest[skin]) < 1
    far = np.linalg.norm(made[skin] - small.centre, axis=1) / small.radius
    before = np.linalg.norm(rest[skin] - small.centre, axis=1) / small.radius
    moved = np.linalg.norm(made[skin] - rest[skin], axis=1) > 1e-12
    assert sunk.any() and moved.any() and not moved[~sunk].any()
    assert (far[sunk & (before < 1.25)] <= SUNK + 1e-9).all()
    others = np.setdiff1d(np.arange(len(rest)), [*skin, *OWN])
    assert (made[others] == rest[others]).all() and (with_eyes(TEMPLATE, rest, rest, {}) == rest).all()
