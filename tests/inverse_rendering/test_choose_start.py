"""Choice of the initial geometry, with landmarks of the template itself and without stereo."""

from typing import Any

import numpy as np
import pytest

from pipeline.errors import StageError
from pipeline.meshes import F64
from pipeline.registration.shell import outer_shell, shell_distance
from pipeline.template.load import load_template
from stages.inverse_rendering.choose_start import ChosenStart, choose_start
from stages.inverse_rendering.config import PRIORS, Config
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.template_start import BEYOND_STEREO, FAR, landmarks_off
from tests.inverse_rendering.test_keep_silhouettes import met
from tests.support.curtains import in_curtain, matrix_k, photo, pose

TEMPLATE = load_template()
CELL, SHAPE = 0.006, (56, 76, 62)
LO = np.array([-0.17, -0.26, -0.19])
EMPTY = np.zeros((4, 4), np.float32)  # a mask that asks for nothing
CAMERAS = [PhotoView(i, np.zeros((4, 4, 3), np.float32), EMPTY, np.eye(3),
                     np.block([[np.eye(3), np.array([[x], [0.0], [0.9]])], [0, 0, 0, 1]]), np.zeros(5))
           for i, x in enumerate((-0.3, 0.0, 0.3))]  # fmt: skip


def marks() -> F64:
    out = np.full((468, 3), np.nan)
    out[TEMPLATE.landmarks.network] = TEMPLATE.landmark_points(TEMPLATE.vertices)
    return out


def box() -> Start:
    """What an arc of photos leaves of a head: a block around it, open to the front and the back."""
    node = np.stack(np.meshgrid(*(LO[a] + CELL * np.arange(SHAPE[a]) for a in range(3)), indexing="ij"), -1)
    half = np.abs(TEMPLATE.vertices).max(0) + [0, 0, 0.04]
    return Start(np.max(np.abs(node) - half, axis=-1).astype(np.float32), LO.astype(np.float32), CELL)


def head() -> Start:
    shell = outer_shell(TEMPLATE)
    found = shell_distance(shell.vertices(TEMPLATE.vertices), shell.faces, LO, CELL, SHAPE)
    return Start(found.values, LO.astype(np.float32), CELL)


def chosen(hull: Start, landmarks: F64 | None, **changes: Any) -> ChosenStart:
    return choose_start(hull, CAMERAS, landmarks, Config(stereo="off", **changes), "cpu")


def test_a_hull_that_hides_the_face_is_cut_by_the_template() -> None:
    found = chosen(box(), marks())
    facts = found.facts["geometry"]
    assert facts["prior"] == PRIORS["template"] and float(facts["landmarks_off_hull_mm"]) > 1e3 * FAR
    assert landmarks_off(found.start, marks(), 1.0) < 0.004
    assert box().values[found.start.values < 0].max() < CELL  # the hull stays the outer limit
    assert found.prior is not box() and np.array_equal(found.prior.values, found.start.values)
    assert found.cut_by_template and found.plain_face is not None


def test_a_hull_with_the_face_stays() -> None:
    hull = head()
    found = chosen(hull, marks())
    assert found.start is hull and found.facts["geometry"]["prior"] == PRIORS["hull"] and not found.cut_by_template
    assert found.near_head is not None and found.plain_face is None
    assert float(found.facts["geometry"]["landmarks_off_hull_mm"]) < 1e3 * FAR


def test_long_hair_stays_beside_a_face_that_it_hides_from_the_silhouettes() -> None:
    """Cameras all around, and a hull that is closed before the face by the hair on both sides of it."""
    views = []
    for i, angle in enumerate(np.radians([-40, -20, 0, 20, 40, 90, 140, 180, 220, 270])):
        colour, subject = photo(pose(angle))
        views.append(PhotoView(i, colour.astype(np.float32), subject.astype(np.float32), matrix_k(), pose(angle),
                               np.zeros(5)))  # fmt: skip
    node = np.stack(np.meshgrid(*(LO[a] + CELL * np.arange(SHAPE[a]) for a in range(3)), indexing="ij"), -1)
    block = np.max(np.abs(node - [0, -0.03, 0.02]) - [0.085, 0.12, 0.12], axis=-1)
    hull = Start(np.minimum(head().values, block).astype(np.float32), LO.astype(np.float32), CELL)
    found = choose_start(hull, views, marks(), Config(stereo="off"), "cpu", showing=range(5))
    facts = found.facts["geometry"]
    assert facts["prior"] == PRIORS["hull"] and float(facts["landmarks_off_hull_mm"]) > 1e3 * BEYOND_STEREO
    assert landmarks_off(found.start, marks(), 1.0) < 0.006
    curtain = in_curtain(node.reshape(-1, 3)).reshape(SHAPE) & (block < -CELL)
    assert curtain.sum() > 500 and (found.start.values[curtain] < 0).mean() > 0.97
    hidden = choose_start(hull, views, marks(), Config(stereo="off"), "cpu")  # no photo is known to show the face
    assert hidden.facts["geometry"]["prior"] == PRIORS["template"]
    arc = choose_start(hull, views[:5], marks(), Config(stereo="off"), "cpu", showing=range(5))
    assert arc.facts["geometry"]["prior"] == PRIORS["template"]  # no silhouette bounds the back of that hull


@pytest.mark.parametrize("shown", [False, True])
def test_a_tail_behind_the_neck_is_cut_off_unless_a_photo_shows_it(shown: bool) -> None:
    """Few cameras all around leave such a tail; a photo from the side tells whether it is there."""
    lo, shape = LO - [0, 0, 30 * CELL], (*SHAPE[:2], SHAPE[2] + 30)
    shell = outer_shell(TEMPLATE)
    found = shell_distance(shell.vertices(TEMPLATE.vertices), shell.faces, lo, CELL, shape)
    node = np.stack(np.meshgrid(*(lo[a] + CELL * np.arange(shape[a]) for a in range(3)), indexing="ij"), -1)
    back, low = TEMPLATE.vertices[:, 2].min(), TEMPLATE.vertices[:, 1].min()
    tail = np.max(np.abs(node - [0, low + 0.06, back - 0.04]) - [0.03, 0.03, 0.13], axis=-1)
    hull = Start(np.minimum(found.values, tail).astype(np.float32), lo.astype(np.float32), CELL)
    side = np.eye(4)
    side[:3, :3], side[:3, 3] = np.array([[0, 0, 1.0], [0, -1, 0], [1, 0, 0]]), [-1.2, 0, back]
    K = np.array([[300.0, 0, 100], [0, 300.0, 100], [0, 0, 1]])
    surface = (hull if shown else Start(found.values, hull.lo, CELL)).surface("cpu")
    mask = met(surface, K, side, 200)
    view = PhotoView(0, np.zeros((200, 200, 3), np.float32), mask.astype(np.float32), K, side, np.zeros(5))
    start = choose_start(hull, [*CAMERAS, view], marks(), Config(stereo="off"), "cpu").start
    far = (node[..., 2] < back - 0.12) & (tail < -CELL)
    assert far.any() and bool((start.values[far] < 0).any()) is shown
    near = node[..., 2] > back - 0.07
    assert ((start.values < 0) == (hull.values < 0))[near].mean() > 0.9999


def test_without_a_face_the_hull_stays() -> None:
    hull = box()
    for landmarks in (None, np.random.default_rng(0).standard_normal((468, 3))):
        found = chosen(hull, landmarks)
        assert found.start is hull and found.facts["geometry"]["prior"] == PRIORS["hull"]


def test_the_setting_decides() -> None:
    hull = box()
    assert chosen(hull, marks(), prior="hull").start is hull
    assert chosen(head(), marks(), prior="template").facts["geometry"]["prior"] == PRIORS["template"]
    for landmarks in (None, np.full((468, 3), np.nan)):
        with pytest.raises(StageError, match="template"):
            chosen(hull, landmarks, prior="template")


def test_landmarks_lie_off_by_their_distance() -> None:
    values = np.broadcast_to((LO[0] + CELL * np.arange(SHAPE[0]))[:, None, None], SHAPE).astype(np.float32)
    plane = Start(values.copy(), LO.astype(np.float32), CELL)
    points = np.full((468, 3), np.nan)
    points[:5] = [[0.01, 0, 0], [0.02, 0, 0], [-0.03, 0, 0], [0.05, 0, 0], [0.0, 0, 0]]
    assert landmarks_off(plane, points, 2.0) == pytest.approx(0.01, abs=1e-4)
