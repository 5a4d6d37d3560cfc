"""Compiled distances outside silhouettes against plain numpy: the public projection, and scipy's interpolation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from pipeline.silhouette_kernels import DECIDED_EVERY, largest_outside
from pipeline.silhouettes import Silhouette, outside, silhouette, stack
from pipeline.transforms import apply, project
from tests.pipeline.test_hull import CELL, LENS, around, looking_at, sphere_alpha

F64 = npt.NDArray[np.float64]


def views(count: int = 6) -> list[Silhouette]:
    """Half of them with a lens, and with silhouettes of different sizes."""
    cameras = [*around(count - count // 2), *around(count // 2, distortion=LENS)]
    return [silhouette(c, sphere_alpha(c, 0.05 + 0.01 * i), np.zeros(3), CELL) for i, c in enumerate(cameras)]


def points(count: int = 4000, edge: float = 2.0) -> F64:
    """Inside and outside of frames, in front of cameras and behind them."""
    return np.random.default_rng(0).uniform(-edge, edge, (count, 3)) ** 3 / edge**2


def plainly(view: Silhouette, x: F64, reach: float) -> tuple[F64, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """What `outside` says, by functions that it does not use."""
    uv, z = project(view.K, view.cam_from_world, view.distortion, x)
    front = z > 1e-9
    uv, z = np.where(front[:, None], uv, -1e9), np.where(front, z, 1.0)
    if view.distortion.any():
        front &= np.hypot(*apply(view.cam_from_world, x)[:, :2].T) < view.radius * z + reach
    h, w = view.distance.shape
    at = np.clip(uv[:, ::-1] / (view.height, view.width) * (h, w) - 0.5, 0, (h - 1.001, w - 1.001))
    value = ndimage.map_coordinates(view.distance.astype(np.float64), at.T, order=1) * z / view.focal
    edges = np.stack([uv[:, 0], uv[:, 1], view.width - uv[:, 0], view.height - uv[:, 1]]).min(0)
    room = reach * view.focal / z
    return value, front & (edges >= room), front & ((edges > -room) if reach else (edges >= 0))


@pytest.mark.parametrize("reach", [0.0, 0.03])
def test_distances_and_frames(reach: float) -> None:
    x = points()
    for view in views():
        value, whole, part = outside(view, x, reach)
        wanted, all_of_it, some = plainly(view, x, reach)
        assert 0 < all_of_it.sum() < len(x)
        np.testing.assert_allclose(value[some], wanted[some], rtol=1e-5, atol=1e-7)
        np.testing.assert_array_equal(whole, all_of_it)
        np.testing.assert_array_equal(part, some)
        if reach:
            assert (some & ~all_of_it).any()


@pytest.mark.parametrize("kept", [1, 3, 9])
@pytest.mark.parametrize("reach", [0.0, 0.03])
def test_the_largest_distances(kept: int, reach: float) -> None:
    """In descending order over all views, with nothing (-inf) where fewer views see a point."""
    seen_by, x = views(), points()
    sure, maybe, seen, glimpsed = _largest(seen_by, x, kept, reach, far=np.inf)
    each = [outside(v, x, reach) for v in seen_by]
    for got, k in ((sure, 1), (maybe, 2)):
        if k == 2 and not reach:
            assert (got == -np.inf).all()
            continue
        values = np.stack([np.where(e[k], e[0], -np.inf) for e in each])
        padded = np.concatenate([values, np.full((kept, len(x)), -np.inf)])
        np.testing.assert_array_equal(got, -np.sort(-padded, 0)[:kept])
    np.testing.assert_array_equal(seen, sum(e[1].astype(int) for e in each))
    np.testing.assert_array_equal(glimpsed, sum(e[2].astype(int) for e in each))


def test_what_is_carved_is_left() -> None:
    """A point far outside of one silhouette is not asked in all views; its largest distance is above the limit."""
    seen_by, x = views(3 * DECIDED_EVERY), np.array([[0.09, 0.0, 0.0], [0.0, 0.0, 0.0]])
    sure, _, seen, _ = _largest(seen_by, x, 1, 0.0, far=0.0)
    assert sure[0, 0] > 0 > sure[0, 1]
    assert seen[0] <= 2 * DECIDED_EVERY < seen[1] == len(seen_by)


def test_nothing_and_what_is_behind() -> None:
    view = silhouette(looking_at([0, 0, 1.0]), sphere_alpha(looking_at([0, 0, 1.0])), np.zeros(3), CELL)
    assert [len(p) for p in outside(view, np.zeros((0, 3)), 0.0)] == [0, 0, 0]
    value, whole, part = outside(view, np.array([[0, 0, 2.0], [0, 0, 1.0], [0, 0, 1e12]]), 0.01)
    assert np.isfinite(value).all() and not whole.any() and not part.any()


def _largest(
    seen_by: list[Silhouette], x: F64, kept: int, reach: float, far: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.int16], npt.NDArray[np.int16]]:
    of = stack(seen_by)
    sure, maybe = (np.full((kept, len(x)), -np.inf, np.float32) for _ in range(2))
    seen, glimpsed = (np.zeros(len(x), np.int16) for _ in range(2))
    largest_outside(
        x, of.views, of.shapes, of.starts, of.distances, reach, np.float32(far), sure, maybe, seen, glimpsed
    )
    return sure, maybe, seen, glimpsed
