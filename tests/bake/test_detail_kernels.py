"""The photo detail's inner loops on single points, by hand: cameras on one line that look along +z at a wall."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from pipeline.artifacts import Camera
from pipeline.transforms import rows
from pipeline.visibility import FittedPhoto
from stages.bake import detail, detail_kernels, detail_views

SIDE = 8
X, N = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
CORNER, WEIGHTS = np.array([[0, 1, 2]], np.int32), np.array([[0.2, 0.3, 0.5]], np.float32)
F32 = np.float32


def photos(colours: np.ndarray, distance: np.ndarray, sharp: np.ndarray) -> detail_views.Photos:
    """One photo of one colour (3,) from each distance before the wall."""
    cameras, pixels = np.zeros((len(colours), detail_kernels.ROW)), []
    for v, (row, colour) in enumerate(zip(cameras, colours, strict=True)):
        z = 1 - distance[v]
        row[:12] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, -z]
        row[12:22] = [100, 0, SIDE / 2, 100, SIDE / 2, 1, SIDE, SIDE, SIDE, SIDE]
        row[27:30] = 0, 0, z
        row[30:39] = np.eye(3).ravel()
        row[39:43] = 1.0, sharp[v], v * SIDE * SIDE, v * SIDE * SIDE
        pixels.append(np.broadcast_to(np.round(np.sqrt(colour) * 65535), (SIDE * SIDE, 3)))
    depth = np.full(len(colours) * SIDE * SIDE, 100.0, F32)
    return detail_views.Photos(cameras, np.concatenate(pixels).astype(np.uint16), depth, np.zeros(0, np.uint8))


def looked(p: detail_views.Photos, albedo: float, shade: float = 1.0) -> tuple[np.ndarray, float]:
    """Detail (3,) and weight of the point."""
    empty = np.zeros((len(p.cameras), 3, 3), F32)
    point = detail.Points(X, N, CORNER, WEIGHTS, np.full((1, 3), albedo, F32), np.full((1, 3), shade, F32))
    bands = np.zeros((3, len(p.cameras), 6), F32)
    added, weight = detail.Detail(p, empty, bands, np.zeros((0, 0, 3), F32)).added(point)
    return added[0], float(weight[0])


def test_the_residual_is_the_photos_albedo_less_the_fields() -> None:
    """a_v - a with a_v = (I - g) / S, g between the triangle's corners."""
    colour, gloss = np.array([0.3, 0.25, 0.2]), np.array([[0.05, 0.1, 0.0], [0.02, 0.0, 0.1], [0.08, 0.04, 0.02]], F32)
    p = photos(colour[None], np.array([1.0]), np.array([1.0]))
    albedo, shade = np.array([[0.2, 0.2, 0.1]], F32), np.array([[1.2, 0.8, 1.5]], F32)
    out, cosines = np.zeros((1, 3), F32), np.zeros(1, F32)
    detail_kernels.residual(
        p.cameras, 0, p.pixels, p.depth, p.clipped, X, N, CORNER, WEIGHTS, gloss, albedo, shade, out, cosines
    )
    np.testing.assert_allclose(out[0], (colour - WEIGHTS[0] @ gloss) / shade[0] - albedo[0], atol=1e-4)
    assert cosines[0] == 1


def test_a_photo_counts_by_the_fourth_power_of_its_resolution() -> None:
    """Sharpness over distance: 1, a half and a third, and a blurred one."""
    distance, sharp = np.array([1.0, 2.0, 3.0, 1.0]), np.array([1.0, 1.0, 1.0, 0.5])
    weight = looked(photos(np.full((4, 3), 0.3), distance, sharp), 0.3)[1]
    assert weight == pytest.approx(float(((sharp / distance) ** 4).sum()), rel=1e-5)


def test_the_photos_of_the_largest_weight_count_whatever_the_order() -> None:
    """Against all weights sorted: twelve photos, two with one weight, one that does not see the point. The better they
    are, the brighter, so that a wrong choice shows."""
    rng = np.random.default_rng(2)
    distance = rng.uniform(1, 2, 12)
    distance[7] = distance[2]  # the same weight: the first of them is taken
    p = photos(np.linspace(0.2, 0.4, 12)[:, None].repeat(3, 1), distance, np.ones(12))
    best = int(np.argmin(distance))
    p.depth[best * SIDE * SIDE : (best + 1) * SIDE * SIDE] = 0.0
    weights = distance**-4
    wanted = [v for v in np.lexsort((np.arange(12), -weights)) if v != best][: detail_kernels.MAX_PHOTOS]
    for seed in range(6):
        order = np.random.default_rng(seed).permutation(12)
        chosen, places = np.empty(detail_kernels.MAX_PHOTOS), np.empty((detail_kernels.MAX_PHOTOS, 2))
        views = np.empty(detail_kernels.MAX_PHOTOS, np.int64)
        count = detail_kernels._best(p.cameras, order, p.depth, p.clipped, X, N, 0, chosen, views, places)
        assert views[:count].tolist() == sorted(wanted)
        np.testing.assert_allclose(chosen[:count], weights[sorted(wanted)], rtol=1e-12)
    low, high = [v for v in range(12) if v != best][:2]
    asked = np.array([high, best, low])
    assert detail_kernels._best(p.cameras, asked, p.depth, p.clipped, X, N, 0, chosen, views, places) == 2
    assert views[:2].tolist() == [low, high]


def test_the_detail_does_not_depend_on_the_order_of_the_points() -> None:
    rng = np.random.default_rng(6)
    p = photos(rng.uniform(0.25, 0.35, (12, 3)), rng.uniform(1, 2, 12), np.ones(12))
    x = np.concatenate([rng.uniform(-0.02, 0.02, (300, 2)), np.ones((300, 1))], 1)
    corner, weights = np.tile(CORNER, (300, 1)), rng.dirichlet(np.ones(3), 300).astype(F32)
    bands, flat = rng.normal(scale=0.01, size=(3, 12, 6)).astype(F32), np.full((300, 3), 0.3, F32)
    found = []
    for order in (np.arange(300), rng.permutation(300)):
        out, support = np.zeros((300, 3), F32), np.zeros((300, 2), F32)
        detail_kernels.fine(
            p.cameras, p.pixels, p.depth, p.clipped, order, x, np.tile(N, (300, 1)), corner, weights, bands,
            np.zeros((0, 0, 3), F32), flat, np.ones((300, 3), F32), out, support,
        )  # fmt: skip
        found.append((out, support))
    assert (found[0][1][:, 0] > 0).sum() > 200
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])


@pytest.mark.parametrize("apart", [0.0, 0.01, 0.03])
def test_less_is_added_where_photos_disagree(apart: float) -> None:
    """h / (1 + (s / DISAGREEMENT)^2) W / (W + HALF_WEIGHT) of three photos, none of which is an outlier."""
    values = 0.05 + apart * np.array([-1.0, 0.0, 1.0])
    p = photos(np.repeat(0.3 + values[:, None], 3, 1), np.array([2.0, 2.0, 2.0]), np.ones(3))
    added, weight = looked(p, 0.3)
    s = apart * np.sqrt(2 / 3)
    expected = 0.05 / (1 + (s / detail.DISAGREEMENT) ** 2) * weight / (weight + detail.HALF_WEIGHT)
    assert weight == pytest.approx(3 / 16)
    np.testing.assert_allclose(added, expected, atol=1e-4)


def test_the_mean_over_photos_is_hubers() -> None:
    """Against the minimum of the weighted Huber cost, whose width follows from the mean distance to the median."""
    values = np.array([[0.01, 0.0], [0.012, -0.01], [0.016, 0.02], [0.02, 0.01], [0.2, 0.015]])
    values = np.concatenate([values, values[:, :1]], 1)
    weights, out = np.array([1.0, 0.8, 1.2, 0.9, 1.0]), np.zeros(3)
    detail_kernels._robust_mean(values, weights, len(values), out)
    for k in range(3):
        x = values[:, k]
        order = np.argsort(x)
        centre = x[order][np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)]
        spread = 1.2533 * (weights * np.abs(x - centre)).sum() / weights.sum()
        limit = detail_kernels.HUBER * max(spread, detail_kernels.MIN_SPREAD)

        def cost(c: float, x: np.ndarray = x, limit: float = limit) -> float:
            far = np.abs(x - c)
            return float((weights * np.where(far <= limit, far**2 / 2, limit * (far - limit / 2))).sum())

        best = minimize_scalar(cost, bounds=(x.min(), x.max()), method="bounded", options={"xatol": 1e-9})
        assert out[k] == pytest.approx(best.x, abs=1e-3)
    assert out[0] < values[:, 0].mean() - 0.01, "the outlier counts little"


def test_a_cameras_row_takes_its_colours_back() -> None:
    response = np.array([[1.1, 0.1, 0.0], [0.0, 0.9, 0.2], [0.05, 0.0, 1.0]])
    camera = Camera(
        index=0, name="0.png", width=SIDE, height=SIDE, K=rows(np.diag([100.0, 100.0, 1.0])),
        world_from_cam=rows(np.eye(4)), distortion=(0,) * 5,
    )  # fmt: skip
    row = detail_views._row(FittedPhoto(camera, None), response, 1, (SIDE, SIDE, 3), (SIDE, SIDE), 1.0, [0, 0])
    np.testing.assert_allclose(row[30:39].reshape(3, 3) @ response, np.eye(3), atol=1e-12)
