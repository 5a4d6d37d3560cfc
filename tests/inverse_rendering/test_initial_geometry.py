"""The start's hull: masks that contradict all others do not cut the subject off."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from pipeline.artifacts import Cut, Extent
from pipeline.extent import GROWN
from stages.inverse_rendering.initial_geometry import agreed, hull_start
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable
from tests.support.two_balls import BOTTOM, FOCAL, HEAD, TORSO, WIDTH, bust_alpha, camera_at, cropped_bust, ring_camera

F32 = npt.NDArray[np.float32]
RADIUS = 0.18
CAMERAS = [ring_camera(i, 24) for i in range(24)]
ALPHAS = [bust_alpha(c) for c in CAMERAS]


def solid(alphas: list[F32]) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.float64]]:
    start = hull_start(CAMERAS, agreed(CAMERAS, alphas, RADIUS).alphas, RADIUS, 64, 1)
    inside = start.values < 0
    return inside, start.lo + start.cell * np.argwhere(inside)


def volume(alphas: list[F32]) -> float:
    start = hull_start(CAMERAS, agreed(CAMERAS, alphas, RADIUS).alphas, RADIUS, 64, 1)
    return float((start.values < 0).sum() * start.cell**3)


def test_masks_that_agree_stay_the_same_objects() -> None:
    found = agreed(CAMERAS, ALPHAS, RADIUS)
    assert not found.doubtful
    assert all(a is b for a, b in zip(found.alphas, ALPHAS, strict=True))


def test_three_masks_that_lack_a_part_cut_nothing_off() -> None:
    cuts_nothing_off("torso", (7, 12, 18))


@pytest.mark.slow
@pytest.mark.parametrize(("lost", "views"), [("torso", (7,)), ("head", (7,)), ("head", (7, 12, 18))])
def test_masks_that_lack_a_part_cut_nothing_off(lost: str, views: tuple[int, ...]) -> None:
    cuts_nothing_off(lost, views)


def cuts_nothing_off(lost: str, views: tuple[int, ...]) -> None:
    alphas = [a.copy() for a in ALPHAS]
    rows = slice(BOTTOM, None) if lost == "torso" else slice(None, BOTTOM)
    for i in views:
        alphas[i][rows] = 0
    found = agreed(CAMERAS, alphas, RADIUS)
    assert tuple(found.doubtful) == views
    for i in views:
        wrong = (ALPHAS[i] > 0.5) & (alphas[i] < 0.5)
        assert (found.doubtful[i] & wrong).sum() > 0.9 * wrong.sum()
        assert not (found.doubtful[i] & (alphas[i] > 0.5)).any()
    assert volume(alphas) == pytest.approx(volume(ALPHAS), rel=0.02)
    _, points = solid(alphas)
    for middle, radius in (HEAD, TORSO):
        assert (np.linalg.norm(points - np.array(middle), axis=1) < 0.5 * radius).any()


@pytest.mark.slow
def test_an_empty_mask_among_many() -> None:
    alphas = [*ALPHAS[:5], np.zeros_like(ALPHAS[5]), *ALPHAS[6:]]
    assert volume(alphas) == pytest.approx(volume(ALPHAS), rel=0.02)


def test_what_many_masks_call_background_is_background() -> None:
    """A quarter of the views outvotes the rest: a hollow that few views look into must stay one."""
    alphas = [a.copy() for a in ALPHAS]
    for i in range(0, 24, 4):
        alphas[i][BOTTOM:] = 0
    assert not agreed(CAMERAS, alphas, RADIUS).doubtful


def test_a_mask_carves_what_few_frames_show() -> None:
    """The torso leaves most frames. One view from the side shows how deep it is, and the others lose nothing by it."""
    cameras, alphas = cropped_bust()
    assert not agreed(cameras, alphas, RADIUS).doubtful
    behind = []
    for n in (len(cameras), len(cameras) - 1):
        start = hull_start(cameras[:n], agreed(cameras[:n], alphas[:n], RADIUS).alphas, RADIUS, 40, 1)
        points = start.lo + start.cell * np.argwhere(start.values < 0)
        at_its_middle = np.abs(points[:, 1] - TORSO[0][1]) < 0.03
        depth = np.abs(points[at_its_middle, 2]) - TORSO[1]
        behind.append(int(((depth > 0.02) & (depth < 0.07)).sum()))  # in the frame of the view from the side
    assert behind[0] < 0.05 * behind[1] and behind[1] > 200


def test_a_narrow_strip_is_left_to_the_mask() -> None:
    """A contour that lies a pixel or two inside the subject's is no contradiction: the lenient hull is a thick one."""
    alphas = list(ALPHAS)
    alphas[4] = np.asarray(cv2.erode(ALPHAS[4], np.ones((5, 5), np.uint8)), np.float32)
    assert agreed(CAMERAS, alphas, RADIUS).alphas[4] is alphas[4]


@pytest.mark.slow
def test_the_start_ends_a_little_beyond_the_extent() -> None:
    """The torso is cut off below the neck; the head stays as it is."""
    cut = Cut(normal=(0.0, -1.0, 0.0), offset=0.08)
    ball = Extent(centre=(0, 0, 0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.2,) * 3, cuts=(cut,), head=0.1)
    whole = hull_start(CAMERAS, ALPHAS, RADIUS, 64, 1)
    start = hull_start(CAMERAS, ALPHAS, RADIUS, 64, 1, ball)
    y = (start.lo + start.cell * np.argwhere(start.values < 0))[:, 1]
    before = (whole.lo + whole.cell * np.argwhere(whole.values < 0))[:, 1]
    assert before.min() < -0.2 and y.min() == pytest.approx(-0.08 - GROWN * 0.1, abs=1.5 * start.cell)
    assert y.max() == pytest.approx(before.max(), abs=whole.cell + start.cell)
    assert start.cell < whole.cell  # the same cells for less space


def test_an_extent_larger_than_the_region_of_interest_is_fitted_as_a_whole() -> None:
    """All pixels inside the extent count, so the start must not end before it does."""
    ball = Extent(centre=(0, 0, 0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.15,) * 3, cuts=(), head=0.1)
    start = hull_start(CAMERAS, ALPHAS, 0.04, 32, 1, ball)
    y = (start.lo + start.cell * np.argwhere(start.values < 0))[:, 1]
    (_, middle, _), radius = HEAD
    assert y.max() == pytest.approx(middle + radius, abs=2 * start.cell)
    assert y.min() == pytest.approx(-0.15 - GROWN * 0.1, abs=2 * start.cell)


def test_within_an_extent_a_part_that_two_frames_show_belongs_to_the_subject() -> None:
    """All other frames end at the neck. Without an extent nothing would end what two silhouettes leave open."""
    around, _ = cropped_bust()
    cameras = [*around[:24], camera_at(0.0, 0.0, 24), camera_at(np.pi / 2, 0.0, 25)]
    alphas = [bust_alpha(c) for c in cameras]
    ball = Extent(centre=(0, 0, 0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.2,) * 3, cuts=(), head=0.1)
    bounded, free = (hull_start(cameras, alphas, RADIUS, 40, 1, e) for e in (ball, None))
    lowest = [float((s.lo + s.cell * np.argwhere(s.values < 0))[:, 1].min()) for s in (bounded, free)]
    assert lowest[0] == pytest.approx(-0.2 - GROWN * 0.1, abs=2 * bounded.cell)
    assert lowest[1] > -0.12


def test_pixels_beyond_the_extent_are_not_drawn() -> None:
    """Neither as subject nor as background."""
    camera, alpha = CAMERAS[0], ALPHAS[0]
    asked = np.where((np.arange(WIDTH) >= BOTTOM)[:, None] & (alpha > 0), 0, 1).astype(np.float32)
    view = PhotoView(0, np.full((WIDTH, WIDTH, 3), 0.5, np.float32), alpha, np.array(camera.K),
                     np.array(camera.world_from_cam), np.zeros(5))  # fmt: skip
    all_of_it, part = (PixelTable([v], WIDTH, "cpu") for v in (view, replace(view, asked=asked)))
    assert len(all_of_it.inside) - len(part.inside) == int((asked == 0).sum()) > 1000
    assert len(part.outside) == len(all_of_it.outside)
    assert float(part.xy[part.inside][:, 1].max()) < (BOTTOM - WIDTH / 2) / FOCAL
