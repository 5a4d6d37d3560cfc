"""The space that a person with a placed head can fill, on the template itself seen from the front."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.hull import Hull
from pipeline.meshes import F64
from pipeline.registration.carve import CHEST, ELSEWHERE, FAR, carved_hull, possible_space, space_near_head
from pipeline.registration.identity_fit import placed_on_face
from pipeline.template.load import load_template
from pipeline.transforms import apply, similarity

TEMPLATE = load_template()
CELL = 0.005
LO = np.array([-0.2, -0.28, -0.2])
SHAPE = (81, 101, 81)
FRONT = np.array([[x, 0.05, 0.9] for x in (-0.3, 0.0, 0.3)])  # an arc of cameras in front of the face


def marks(vertices: F64) -> F64:
    out = np.full((468, 3), np.nan)
    out[TEMPLATE.landmarks.network] = TEMPLATE.landmark_points(vertices)
    return out


@pytest.fixture(scope="module")
def space() -> Callable[[F64], F64]:
    head = placed_on_face(TEMPLATE, marks(TEMPLATE.vertices))
    assert head is not None
    values = possible_space(TEMPLATE, head, FRONT, LO, CELL, SHAPE)

    def at(points: F64) -> F64:
        index = np.rint((np.asarray(points) - LO) / CELL).astype(int)
        return np.asarray(values[tuple(index.T)], np.float64)

    return at


def middle(region: str) -> F64:
    return np.asarray(TEMPLATE.vertices[np.unique(TEMPLATE.quads[TEMPLATE.regions[region]])].mean(0), np.float64)


def test_the_face_is_bounded_closely_in_front_and_free_inside(space: Callable[[F64], F64]) -> None:
    nose = TEMPLATE.vertices[np.argmax(TEMPLATE.vertices[:, 2])]
    ahead = nose + [0, 0, 0.02]
    inside = nose - [0, 0, 0.02]
    assert space(ahead[None])[0] > 0.02 - ELSEWHERE - 2 * CELL and space(inside[None])[0] < 0


def test_hair_may_stand_out_at_the_side_more_than_on_the_face(space: Callable[[F64], F64]) -> None:
    points = TEMPLATE.vertices[np.unique(TEMPLATE.quads[TEMPLATE.regions["scalp"]])]
    side = points[np.argmax(points[:, 0])]
    assert space((side + [0.04, 0, 0])[None])[0] < 0  # the silhouette decides there
    brow = middle("brows")
    brow[0], brow[2] = 0.0, TEMPLATE.vertices[np.abs(TEMPLATE.vertices[:, 0]) < 0.02][:, 2].max()
    assert space((brow + [0, 0, 0.02])[None])[0] > 0


def test_behind_the_head_nothing_goes_on(space: Callable[[F64], F64]) -> None:
    back = TEMPLATE.vertices[np.argmin(TEMPLATE.vertices[:, 2])]
    assert space((back - [0, 0, 0.05])[None])[0] > 0


def test_shoulders_are_free_below_the_chin_but_not_in_front_of_the_chest(space: Callable[[F64], F64]) -> None:
    chin = TEMPLATE.landmark_points(TEMPLATE.vertices)[:, 1].min()
    shoulder = np.array([0.17, chin - 0.12, -0.03])
    assert space(shoulder[None])[0] < 0
    nose = TEMPLATE.vertices[:, 2].max()
    assert space(np.array([[0.0, chin - 0.12, nose + CHEST + 0.03]]))[0] > 0


def test_what_is_far_before_and_behind_is_told_in_any_world() -> None:
    """Twice as large, turned and elsewhere: the distances are those of the world."""
    world = similarity(2.0, np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), np.array([0.3, 0.1, -0.2]))
    head = placed_on_face(TEMPLATE, marks(apply(world, TEMPLATE.vertices)))
    assert head is not None
    z = TEMPLATE.vertices[np.unique(TEMPLATE.quads[TEMPLATE.parts["skin"]]), 2]
    points = np.array([[0.1, -0.2, z.min() - FAR - 0.02], [0.1, -0.2, z.min() - FAR + 0.02], [0, 0, 0],
                       [0, 0.1, z.max() + FAR + 0.02]])  # fmt: skip
    found = [float(space_near_head(TEMPLATE, head, p, 1.0, (1, 1, 1))[0, 0, 0]) for p in apply(world, points)]
    assert found[:2] == pytest.approx([0.04, -0.04], abs=0.01) and found[3] == pytest.approx(0.04, abs=0.01)
    assert found[2] < -2 * FAR


def test_a_block_becomes_a_head() -> None:
    """A hull that fills the whole box, as photos from one side leave it; in another place, size and direction."""
    world = similarity(2.0, np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), np.array([0.3, 0.1, -0.2]))
    vertices = apply(world, TEMPLATE.vertices)
    head = placed_on_face(TEMPLATE, marks(vertices))
    assert head is not None
    cell, shape = 0.02, (44, 48, 44)
    lo = vertices.mean(0) - 0.5 * cell * np.array(shape)
    level = np.full(shape, -2 * cell, np.float32)
    block = Hull(level < 0, level, np.ones(shape, np.int16), lo, cell)
    cut = carved_hull(block, TEMPLATE, head, apply(world, FRONT))
    assert 0.05 < cut.occupied.mean() < 0.4
    inside = np.floor((vertices.mean(0) - lo) / cell).astype(int)
    assert cut.occupied[tuple(inside)] and cut.level.max() <= 2 * cell + 1e-6
    nose = apply(world, TEMPLATE.vertices[[np.argmax(TEMPLATE.vertices[:, 2])]] + [0, 0, 0.04])[0]
    assert not cut.occupied[tuple(np.floor((nose - lo) / cell).astype(int))]


def test_landmarks_that_are_no_face_place_no_head() -> None:
    rng = np.random.default_rng(0)
    assert placed_on_face(TEMPLATE, 0.1 * rng.standard_normal((468, 3))) is None
    assert placed_on_face(TEMPLATE, np.full((468, 3), np.nan)) is None
