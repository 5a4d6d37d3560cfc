"""Means over texels around: against sums over all pairs, at edges of tissue, and at the extremes."""

from __future__ import annotations

import numpy as np
import pytest

from stages.reflectance import pooled
from stages.reflectance.pooled import Pooled
from stages.reflectance.texels import Pairs, Points

COUNT = 3000


def plane(count: int = COUNT, seed: int = 0) -> Points:
    """Texels at random places of a plane of 3 cm, normals along z."""
    xy = np.random.default_rng(seed).uniform(-0.015, 0.015, (count, 2))
    position = np.concatenate([xy, np.zeros((count, 1))], 1)
    every, normal = np.arange(count), np.tile([0.0, 0, 1], (count, 1))
    return Points(64, every, every, np.full((count, 3), 1 / 3), position, normal)


def seen_by(weights: np.ndarray) -> Pairs:
    """One camera that sees the texels of positive weight."""
    texel = np.flatnonzero(weights > 0)
    first = np.searchsorted(texel, np.arange(len(weights) + 1))
    return Pairs(first, texel, np.zeros(len(texel), np.int32), weights[texel])


def test_the_mean_is_that_over_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the formula, every texel a cell of its own."""
    monkeypatch.setattr(pooled, "CELL", 1e-6)
    monkeypatch.setattr(pooled, "AROUND", COUNT)
    rng, points = np.random.default_rng(1), plane()
    weights, albedo = rng.uniform(0.1, 1, COUNT), np.exp(rng.normal(-1, 0.2, (COUNT, 3)))
    values = rng.normal(size=(COUNT, 2)).astype(np.float32)
    found = Pooled(points, seen_by(weights), albedo)(values)
    for i in range(0, COUNT, 500):
        far = np.linalg.norm(points.position - points.position[i], axis=1)
        apart = ((np.log(albedo) - np.log(albedo[i])) ** 2).sum(1)
        w = weights * np.exp(-(far**2) / (2 * 0.004**2) - apart / (6 * 0.2**2)) * (far < 0.012)
        np.testing.assert_allclose(found[i], (w @ values) / w.sum(), atol=2e-5)


def test_noise_falls_and_a_slope_stays() -> None:
    points = plane(20_000)
    slope = 0.03 + 0.5 * points.position[:, 0]
    noise = np.random.default_rng(2).normal(0, 0.01, len(slope))
    pool = Pooled(points, seen_by(np.ones(len(slope))), np.full((len(slope), 3), 0.4))
    inner = np.abs(points.position[:, :2]).max(1) < 0.006
    found = pool((slope + noise).astype(np.float32)[:, None])[:, 0]
    assert np.abs(found - slope)[inner].max() < 0.0012 and np.std((found - slope)[inner]) < 0.0005


def test_other_tissue_keeps_its_own() -> None:
    """Lips of another albedo beside skin: no value goes over the border, and both are means of their own."""
    points = plane(8000)
    lips = points.position[:, 0] > 0
    albedo = np.where(lips[:, None], [0.5, 0.2, 0.18], [0.6, 0.42, 0.33])
    values = np.where(lips, 0.04, 0.02).astype(np.float32)[:, None]
    found = Pooled(points, seen_by(np.ones(8000)), albedo)(values)[:, 0]
    border = np.abs(points.position[:, 0]) < 0.001
    assert np.abs(found - values[:, 0])[border].max() < 0.004
    same = Pooled(points, seen_by(np.ones(8000)), np.full((8000, 3), 0.4))(values)[:, 0]
    assert np.abs(same - values[:, 0])[border].max() > 0.007


def test_the_other_side_of_a_sheet_is_another_place() -> None:
    """Two planes a tenth of a millimetre apart that face apart."""
    front, back = plane(4000), plane(4000, seed=3)
    position = np.concatenate([front.position, back.position - [0, 0, 1e-4]])
    normal = np.concatenate([front.normal, -back.normal])
    every = np.arange(8000)
    points = Points(64, every, every, np.full((8000, 3), 1 / 3), position, normal)
    values = (every < 4000).astype(np.float32)[:, None]
    found = Pooled(points, seen_by(np.ones(8000)), np.full((8000, 3), 0.4))(values)
    np.testing.assert_allclose(found, values, atol=1e-6)


def test_what_no_camera_sees_does_not_count() -> None:
    points, weights = plane(), np.ones(COUNT)
    hidden = points.position[:, 1] > 0.012
    weights[hidden] = 0
    values = np.where(hidden, 1e6, 0.03).astype(np.float32)[:, None]
    pool = Pooled(points, seen_by(weights), np.full((COUNT, 3), 0.4))
    assert np.abs(pool(values) - 0.03)[~hidden].max() < 1e-6
    np.testing.assert_allclose(pool(values)[hidden], 0.03, atol=1e-6)  # taken from what is near


def test_extremes() -> None:
    one = plane(1)
    np.testing.assert_allclose(Pooled(one, seen_by(np.ones(1)), np.full((1, 3), 0.4))(np.ones((1, 2), np.float32)), 1)
    none = Pooled(plane(10), seen_by(np.zeros(10)), np.full((10, 3), 0.4))
    values = np.arange(10, dtype=np.float32)[:, None]
    np.testing.assert_array_equal(none(values), values)
    black = Pooled(plane(), seen_by(np.ones(COUNT)), np.zeros((COUNT, 3)))
    assert np.isfinite(black(np.full((COUNT, 4, 3), 1e6, np.float32))).all()
    far = plane(2)
    far.position[1] = [5.0, 0, 0]  # alone
    pool = Pooled(far, seen_by(np.array([1.0, 0])), np.full((2, 3), 0.4))
    np.testing.assert_array_equal(pool(np.array([[1.0], [7]], np.float32)), [[1], [7]])
