"""Displacement: where it counts, and how it fades."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from support.ball_head import RADIUS, ball_quads

from pipeline.meshes import triangles_of
from pipeline.registration import displacement as module
from pipeline.registration.displacement import AGREE, CLOSE, EASED, SPREAD, displacement
from pipeline.registration.folds import piercing_edges
from pipeline.registration.lips import meeting


def rings_from(outside: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """(n,) number of quads to cross from each vertex to one outside, by a search from vertex to vertex."""
    away = np.where(outside, 0, np.iinfo(np.int64).max)
    for ring in range(1, len(away)):
        reached = [v for q in quads if (away[q] == ring - 1).any() for v in q if away[v] > ring]
        if not reached:
            break
        away[reached] = ring
    return away


def test_it_fades_by_a_third_with_each_ring_of_quads() -> None:
    n, quads = ball_quads(12)
    use = n[:, 1] < 0.4
    expected = np.minimum(rings_from(~use, quads), SPREAD + 1) / (SPREAD + 1)
    np.testing.assert_allclose(module._faded(use, quads), expected)
    assert set(np.round(expected * (SPREAD + 1)).astype(int)) == set(range(SPREAD + 2))


@pytest.mark.parametrize("unit", [1.0, 10.0])
@pytest.mark.parametrize(("beyond", "moves"), [(0.9, True), (1.1, False)])
def test_a_normal_that_meets_another_part_moves_nothing(unit: float, beyond: float, moves: bool) -> None:
    """t against the limit AGREE e + CLOSE, for a surface whose nearest place is e = 0.3 mm off."""
    n, quads = ball_quads(8)
    near = 3e-4 * unit
    t = beyond * (AGREE * near + CLOSE * unit)
    one = np.ones(len(n))
    scan = SimpleNamespace(
        along=lambda points, normals, reach: (t * one, one),
        pairs=lambda points, normals, reach: SimpleNamespace(distance=near * one),
        over=lambda points, normals, reach: 0 * one,
    )
    found, seen = displacement(RADIUS * unit * n, n, quads, np.ones(len(quads), bool), scan, unit)  # type: ignore[arg-type]
    np.testing.assert_allclose(found, t if moves else 0.0)
    assert (seen == (1.0 if moves else 0.0)).all()


def test_what_would_turn_a_facet_over_is_taken_back() -> None:
    """One vertex whose normal meets the other side of a fold, far away: it and its surroundings stay."""
    n, quads = ball_quads(12)
    odd, one = 200, np.ones(len(n))
    t = np.full(len(n), 1e-4)
    t[odd] = 0.04
    scan = SimpleNamespace(
        along=lambda points, normals, reach: (t, one),
        pairs=lambda points, normals, reach: SimpleNamespace(distance=t),
        over=lambda points, normals, reach: 0 * one,
    )
    found, _ = displacement(RADIUS * n, n, quads, np.ones(len(quads), bool), scan, 1.0)  # type: ignore[arg-type]
    assert 0 <= found[odd] < 0.7e-4 and found.max() <= 1e-4 + 1e-12
    away = rings_from(np.arange(len(n)) == odd, quads)
    np.testing.assert_allclose(found[away > SPREAD + 1 + EASED], 1e-4)
    assert found[away == 1].max() < 0.9e-4


def test_closed_lips_meet_and_do_not_pass_through_each_other() -> None:
    """Two sheets with normals that point anywhere within 40 degrees: half of the way at each would make them cross."""
    n = 13
    g = np.linspace(-0.006, 0.006, n)
    x, z = (a.ravel() for a in np.meshgrid(g, g, indexing="ij"))
    at = np.arange(n * n).reshape(n, n)
    patch = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    gap = 4e-4 + 2e-4 * np.sin(900 * x) * np.cos(700 * z)
    points = np.concatenate([np.stack([x, 0 * x, z], 1), np.stack([x, gap, z], 1)])
    random = np.random.default_rng(1).uniform(-0.8, 0.8, (2 * n * n, 2))
    way = np.repeat([1.0, -1.0], n * n)
    normals = np.stack([random[:, 0], way, random[:, 1]], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    quads = np.concatenate([patch[:, ::-1], patch + n * n])
    nothing = np.zeros(len(points))
    scan = SimpleNamespace(
        along=lambda points, normals, reach: (nothing + np.nan, nothing),
        pairs=lambda points, normals, reach: SimpleNamespace(distance=nothing),
        over=lambda points, normals, reach: nothing,
    )
    every = np.ones(len(quads), bool)
    alone, _ = displacement(points, normals, quads, every, scan, 1.0)  # type: ignore[arg-type]
    moved, _ = displacement(points, normals, quads, every, scan, 1.0, every)  # type: ignore[arg-type]
    assert not alone.any()
    inner = np.tile(np.maximum(np.abs(x), np.abs(z)) < 0.004, 2)
    height = (points + moved[:, None] * normals)[:, 1]
    left = (height[n * n :] - height[: n * n])[inner[: n * n]]
    assert np.median(left) < 0.5 * np.median(gap)
    faces = triangles_of(quads)
    assert not len(piercing_edges(points + moved[:, None] * normals, faces))
    assert len(piercing_edges(points + meeting(points, normals, quads, 1.0)[:, None] * normals, faces))


def test_lips_that_pass_through_each_other_are_drawn_apart() -> None:
    """Two bent sheets face to face, that overlap by up to 0.3 mm in their middle."""
    at = np.linspace(-0.01, 0.01, 21)
    x, z = (v.ravel() for v in np.meshgrid(at, at, indexing="ij"))
    cells = np.arange(20 * 21).reshape(20, 21)[:, :20].ravel()
    up = np.stack([cells, cells + 1, cells + 22, cells + 21], 1)
    bulge = 3e-4 * np.exp(-(x * x + z * z) / 2 / 0.004**2) - 5e-5
    tilt = 1e-5 * np.sin(900 * x) * np.cos(700 * z)
    low = np.stack([x, 0.5 * bulge, z], 1)
    high = np.stack([x, -0.5 * bulge + tilt, z], 1)
    points = np.concatenate([low, high])
    quads = np.concatenate([up, up[:, ::-1] + len(x)])
    normals = np.repeat([[0.0, 1, 0], [0.0, -1, 0]], len(x), 0)
    assert len(piercing_edges(points, triangles_of(quads))) > 20
    moved = module._apart(points, np.zeros(len(points)), normals, quads, quads, 1.0)
    now = points + moved[:, None] * normals
    assert len(piercing_edges(now, triangles_of(quads))) == 0
    assert (moved <= 0).all() and moved.min() > -4e-4
    assert (moved[np.hypot(*points[:, [0, 2]].T) > 0.012] == 0).all()
    far = module._apart(points, np.zeros(len(points)), normals, quads, quads[:20], 1.0)
    assert (far[up[40:]] == 0).all()  # only what is closed moves
