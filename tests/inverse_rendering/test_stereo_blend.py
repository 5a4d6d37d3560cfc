"""One start of two: place by place, by how well both show validation views."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.transforms import rigid
from stages.inverse_rendering.dense_stereo import Pictures
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.stereo_blend import PRIOR, WIDTH, blended, share_of_maps
from stages.inverse_rendering.stereo_scores import Shown, Validation, mean_score

CELL, NODES = 0.004, 61
SIDE, FOCAL, AWAY = 120, 300.0, 0.5


def plane(height: float) -> Start:
    """All below a height z is solid; the grid is centred on the origin."""
    x = CELL * (np.arange(NODES) - NODES // 2)
    values = np.broadcast_to(x - height, (NODES,) * 3).astype(np.float32).copy()
    return Start(values, np.full(3, x[0], np.float32), CELL)


def ball(radius: float) -> Start:
    x = CELL * (np.stack(np.meshgrid(*[np.arange(NODES)] * 3, indexing="ij"), -1) - NODES // 2)
    return Start((np.linalg.norm(x, axis=-1) - radius).astype(np.float32), np.full(3, x.min(), np.float32), CELL)


def from_above(views: int = 1) -> Validation:
    """Cameras at the same place above the plane z = 0, which fills their pictures."""
    K = np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    pose = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, AWAY]))
    grey = np.zeros((views, SIDE, SIDE), np.float32)
    none = np.full(grey.shape, np.nan, np.float32)
    pictures = Pictures(grey, np.ones(grey.shape, bool), np.stack([K] * views), none, none, 0.01)
    return Validation(tuple(range(views)), [np.zeros(0, np.intp)] * views, pictures, np.stack([pose] * views))


def shown(score: float | np.ndarray, height: float = 0.0, views: int = 1) -> list[Shown]:
    inverse = np.full((SIDE, SIDE), 1 / (AWAY - height), np.float32)
    return [
        Shown(i, np.broadcast_to(np.asarray(score, np.float32), inverse.shape).copy(), inverse) for i in range(views)
    ]


def at(share: np.ndarray, x: float, y: float, z: float) -> float:
    i, j, k = (round(v / CELL) + NODES // 2 for v in (x, y, z))
    return float(share[i, j, k])


def expected(difference: float, overall: float, views: float) -> float:
    """The formula of the module for `views` views that tell."""
    return float(np.clip((views * difference + PRIOR * overall) / (views + PRIOR) / WIDTH + 0.5, 0, 1))


@pytest.mark.parametrize("views", [1, 3])
def test_each_side_gets_the_start_that_shows_it_better(views: int) -> None:
    """Depth maps are better where x < 0, the sweep where x > 0; far from the border it is as the formula says. Both
    starts lie on the same plane, so that each view counts twice there."""
    better = np.where(np.arange(SIDE) < SIDE / 2, 0.01, -0.01)[None]
    share = share_of_maps(shown(0.5, views=views), shown(0.5 + better, views=views), from_above(views), plane(0.0))
    for x, difference in ((-0.05, 0.01), (0.05, -0.01)):
        assert at(share, x, 0.02, 0.0) == pytest.approx(expected(difference, 0.0, 2.0 * views), abs=0.03)
    assert at(share, 0.0, 0.0, 0.0) == pytest.approx(0.5, abs=0.06)
    across = share[NODES // 2 - 10 : NODES // 2 + 11, NODES // 2 + 5, NODES // 2]
    assert (np.diff(across) < 1e-6).all()


def test_large_differences_leave_nothing_of_the_worse_start() -> None:
    better = np.where(np.arange(SIDE) < SIDE / 2, 0.3, -0.3)[None]
    share = share_of_maps(shown(0.4), shown(0.4 + better), from_above(), plane(0.0))
    assert at(share, -0.05, 0.0, 0.0) == 1 and at(share, 0.05, 0.0, 0.0) == 0


def test_both_places_that_a_pixel_may_show_are_told() -> None:
    """As good as each other on the whole, so that only what is told of a place decides there."""
    better = np.where(np.arange(SIDE) < SIDE / 2, 0.3, -0.3)[None]
    share = share_of_maps(shown(0.4, 0.03), shown(0.4 + better, -0.03), from_above(), plane(0.0))
    for z in (0.03, -0.03):
        assert at(share, -0.05, 0.0, z) == 1 and at(share, 0.05, 0.0, z) == 0


@pytest.mark.parametrize(("sweep", "maps"), [(0.5, 0.5), (0.5, 0.51), (0.6, 0.2)])
def test_where_nobody_looks_the_whole_decides(sweep: float, maps: float) -> None:
    share = share_of_maps(shown(sweep), shown(maps), from_above(), plane(0.0))
    assert at(share, 0.0, 0.0, -0.1) == pytest.approx(expected(0.0, maps - sweep, 0.0), abs=1e-4)


def test_without_any_sight_both_count_alike() -> None:
    blind = [Shown(0, np.zeros((SIDE, SIDE), np.float32), np.zeros((SIDE, SIDE), np.float32))]
    assert (share_of_maps(blind, blind, from_above(), plane(0.0)) == 0.5).all()
    assert (share_of_maps([], [], from_above(), plane(0.0)) == 0.5).all()


def test_a_mean_score_counts_pixels_of_the_subject_only() -> None:
    views = from_above(2)
    views.pictures.usable[0, :, SIDE // 2 :] = False
    mixed = np.where(np.arange(SIDE) < SIDE / 2, 0.4, 9.0)[None]
    one = [shown(mixed)[0], Shown(1, shown(0.1)[0].score, shown(0.1)[0].inverse)]
    assert mean_score(one, views) == pytest.approx((0.4 + 2 * 0.1) / 3, rel=1e-5)
    assert mean_score([], views) == 0


@pytest.mark.parametrize(("share", "radius"), [(0.0, 0.08), (1.0, 0.06), (0.5, 0.07)])
def test_the_surface_lies_between_both(share: float, radius: float) -> None:
    start = blended(ball(0.08), ball(0.06), np.full((NODES,) * 3, share))
    middle = start.values[NODES // 2, NODES // 2]
    k = int(np.flatnonzero(middle < 0).max())
    height = CELL * (k - NODES // 2 + middle[k] / (middle[k] - middle[k + 1]))
    assert height == pytest.approx(radius, abs=2e-4)


def test_a_start_is_never_empty() -> None:
    nothing = Start(np.full((NODES,) * 3, 0.02, np.float32), ball(0.08).lo, CELL)
    assert blended(sweep := ball(0.08), nothing, np.ones((NODES,) * 3)) is sweep
