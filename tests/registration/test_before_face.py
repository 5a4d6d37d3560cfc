"""The space before a face that photos see, on the template with curtains of hair beside its face."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.meshes import F64
from pipeline.registration.before_face import MARGIN, Sight, space_before_face
from pipeline.registration.identity_fit import PlacedHead, placed_on_face
from tests.support.curtains import TEMPLATE, in_curtain, matrix_k, photo, pose

CELL = 0.005
LO = np.array([-0.1, -0.16, -0.11])
SHAPE = (41, 55, 61)
ANGLES = np.radians([-40, -20, 0, 20, 40])


def placed() -> PlacedHead:
    marks = np.full((468, 3), np.nan)
    marks[TEMPLATE.landmarks.network] = TEMPLATE.landmark_points(TEMPLATE.vertices)
    head = placed_on_face(TEMPLATE, marks)
    assert head is not None
    return head


HEAD = placed()


def sight(angle: float, fringe: float = np.inf) -> Sight:
    colour, subject = photo(pose(angle), fringe)
    return Sight(matrix_k(), pose(angle), colour, subject)


def space(sights: list[Sight]) -> F64:
    return np.asarray(space_before_face(TEMPLATE, HEAD, sights, np.ones(SHAPE, bool), LO, CELL), np.float64)


def at(values: F64, *points: tuple[float, float, float]) -> F64:
    index = np.rint((np.array(points) - LO) / CELL).astype(int)
    return np.asarray(values[tuple(index.T)])


NOSE = TEMPLATE.vertices[np.argmax(TEMPLATE.vertices[:, 2])]


@pytest.fixture(scope="module")
def seen() -> F64:
    return space([sight(a) for a in ANGLES])


def test_what_lies_before_the_face_is_empty_up_to_a_margin(seen: F64) -> None:
    x, y, z = NOSE
    assert (at(seen, (x, y, z + 0.02), (x, y + 0.04, z + 0.03), (0.03, -0.03, z + 0.02)) > 0).all()
    assert (at(seen, (x, y, z - 0.02), (0.0, 0.0, 0.0), (0.0, 0.03, -0.05)) < -0.005).all()
    along = np.arange(z - 0.03, z + 0.03, CELL)
    values = at(seen, *[(x, y, float(k)) for k in along])
    border = float(np.interp(0, values, along))
    assert border == pytest.approx(z + MARGIN, abs=1.5 * CELL)


def test_hair_beside_the_face_and_what_no_photo_looks_through_is_not(seen: F64) -> None:
    index = np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"), -1).reshape(-1, 3)
    points = LO + CELL * index
    curtain = in_curtain(points)
    assert (seen.reshape(-1)[curtain] > 0).mean() < 0.02
    behind = points[:, 2] < -0.02
    assert not (seen.reshape(-1)[behind] > 0).any()


def test_a_bare_forehead_is_seen_and_one_under_a_fringe_is_not(seen: F64) -> None:
    before = (0.0, 0.045, 0.12)
    assert at(seen, before)[0] > 0
    covered = space([sight(a, fringe=0.025) for a in ANGLES])
    assert at(covered, before)[0] < 0 < at(covered, (NOSE[0], NOSE[1], NOSE[2] + 0.02))[0]


def test_one_photo_tells_nothing_and_two_do() -> None:
    assert np.isneginf(space([sight(0.0)])).all()
    assert (space([sight(0.0), sight(0.2)]) > 0).any()


@pytest.mark.parametrize("angle", [np.pi, np.pi / 2 + 0.5])
def test_photos_that_do_not_show_the_face_tell_nothing(angle: float) -> None:
    assert np.isneginf(space([sight(angle), sight(angle + 0.05)])).all()


def test_extremes() -> None:
    """No photos; no subject; black photos, in which only the middle of the face is known; only nodes that are asked."""
    assert np.isneginf(space([])).all()
    front = [sight(a) for a in ANGLES]
    nobody = [Sight(s.K, s.world_from_cam, s.colour, np.zeros_like(s.subject)) for s in front]
    assert np.isneginf(space(nobody)).all()
    black = space([Sight(s.K, s.world_from_cam, np.zeros_like(s.colour), s.subject) for s in front])
    assert np.isfinite(black).all() and at(black, (NOSE[0], NOSE[1], NOSE[2] + 0.02))[0] > 0
    none = space_before_face(TEMPLATE, HEAD, front, np.zeros(SHAPE, bool), LO, CELL)
    assert np.isneginf(none).all()
