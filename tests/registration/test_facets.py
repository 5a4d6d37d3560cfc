"""Heights that make flat facets follow a smooth surface in the mean."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from support.ball_head import ball_quads

from pipeline.meshes import triangles_of
from pipeline.registration.facets import raised
from pipeline.registration.head import Head, limit_surface
from pipeline.registration.subdivision import edges_of, subdivided


def on_sphere(radius: float, steps: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals, quads of a sphere, and the sphere at the points of one more step."""
    n, quads = ball_quads(steps)
    ends = np.concatenate([edges_of(quads, len(n)).ends, quads[:, [0, 2]]])
    middle = n[ends].sum(1)
    finer = np.concatenate([n, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
    return radius * n, n, quads, radius * finer


@pytest.mark.parametrize("radius", [1e-3, 0.1, 100.0])
def test_edges_lie_on_a_sphere_in_the_mean(radius: float) -> None:
    """Distance from the sphere along each edge by Gauss-Legendre quadrature: half a per cent of that of plain edges."""
    points, normals, quads, finer = on_sphere(radius)
    t = raised(points, normals, quads, finer)
    assert (t > 0).all()
    s, w = leggauss(8)
    ends = np.concatenate([edges_of(quads, len(points)).ends, quads[:, [0, 2]]])

    def bias(x: np.ndarray) -> float:
        a, b = x[ends[:, 0]], x[ends[:, 1]]
        along = a[:, None] + (0.5 + 0.5 * s)[None, :, None] * (b - a)[:, None]
        away = np.linalg.norm(along, axis=2) - radius
        return float((np.linalg.norm(b - a, axis=1) * (away @ (w / 2))).sum() / np.linalg.norm(b - a, axis=1).sum())

    before, after = bias(points), bias(points + t[:, None] * normals)
    assert before < 0 and abs(after) < 0.03 * abs(before)


def test_the_outline_keeps_its_size() -> None:
    """The area of a sphere's outline, of 200 directions."""
    points, normals, quads, finer = on_sphere(1.0)
    moved = points + raised(points, normals, quads, finer)[:, None] * normals
    ways = np.random.default_rng(0).normal(size=(200, 3))

    def area(x: np.ndarray, way: np.ndarray) -> float:
        across = np.linalg.svd(way[None] / np.linalg.norm(way))[2][1:]
        return float(ConvexHull(x @ across.T).volume)

    small = np.mean([area(points, w) for w in ways]) / np.pi - 1
    kept = np.mean([area(moved, w) for w in ways]) / np.pi - 1
    assert small < -0.01 and abs(kept) < 0.15 * abs(small)


def test_it_is_the_least_of_the_sum() -> None:
    """Against a general minimiser of Simpson's sum, written out, on a patch with random middles."""
    rng = np.random.default_rng(3)
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    points = np.array([[x, y, 0.0] for y in (0, 1) for x in (0, 1, 2.5)]) + rng.normal(0, 0.05, (6, 3)) * [1, 1, 0]
    normals = np.tile([0.0, 0, 1], (6, 1))
    ends = np.concatenate([edges_of(quads, 6).ends, quads[:, [0, 2]]])
    high = rng.normal(0, 0.1, len(ends))
    finer = np.concatenate([points, points[ends].mean(1) + high[:, None] * [0, 0, 1.0]])
    length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)

    def total(t: np.ndarray) -> float:
        a, b = t[ends].T
        return float((length * (a**2 / 6 + 4 / 6 * ((a + b) / 2 - high) ** 2 + b**2 / 6)).sum())

    best = minimize(total, np.zeros(6), tol=1e-14).x
    np.testing.assert_allclose(raised(points, normals, quads, finer), best, atol=1e-6)


def test_flat_quads_stay_and_loose_vertices_too() -> None:
    quads = np.array([[0, 1, 2, 3]])
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5.0, 5, 5]])
    middle = np.concatenate([points[edges_of(quads, 5).ends].mean(1), points[[0, 2]].mean(0)[None]])
    normals = np.tile([0.0, 0, 1], (5, 1))
    finer = np.concatenate([points, middle])
    assert not raised(points, normals, quads, finer).any()
    bent = finer + np.repeat([0.0, 0.1], 5)[:, None] * [0, 0, 1]
    assert raised(points, normals, quads, bent)[4] == 0
    with pytest.raises(ValueError, match="one step more"):
        raised(points, normals, quads, points)


def test_finer_points_of_a_head_begin_with_its_own() -> None:
    """One more subdivision: the first points are the head's, and the displacement goes on between them."""
    n, quads = ball_quads(4)
    none = np.zeros(len(quads), np.int64)
    for levels in (1, 2):
        count = subdivided(quads, len(n), levels).stencil.shape[0]
        own = np.random.default_rng(levels).normal(0, 0.01, count).astype(np.float32)
        head = Head(n, quads, np.zeros((1, 2)), np.zeros((len(quads), 4), int), none, none, own, own, levels)
        finer, fine = head.finer(), head.surface()[2]
        np.testing.assert_allclose(finer[:count], head.displaced(), atol=1e-9)
        points, normals, _ = limit_surface(n, subdivided(quads, len(n), levels + 1))
        assert len(finer) == len(points)
        middle = ((finer - points) * normals).sum(1)[-len(fine) :]
        np.testing.assert_allclose(middle, own[fine].mean(1), atol=1e-7)
        assert len(triangles_of(fine)) == 2 * len(fine)
