"""Signed distances against closed forms, at wrong slopes, and at the extremes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from stages.inverse_rendering.signed_distance import SLOPES, distances

CELL, NODES = 0.004, 49
LO = np.full(3, -CELL * (NODES // 2), np.float32)
X = LO[0] + CELL * np.stack(np.meshgrid(*[np.arange(NODES)] * 3, indexing="ij"), -1).astype(np.float64)


def ball(radius: float = 0.05, centre: tuple[float, float, float] = (0.001, 0.0005, -0.0007)) -> np.ndarray:
    return np.asarray(np.linalg.norm(X - centre, axis=-1) - radius)


def plane(direction: tuple[float, float, float]) -> np.ndarray:
    n = np.array(direction) / np.linalg.norm(direction)
    return np.asarray(X @ n - 0.0013)


@pytest.mark.parametrize("slope", [0.55, 1.0, 1.8])
def test_a_ball_of_any_slope(slope: float) -> None:
    """To a twentieth of a cell next to the surface, to a quarter within five cells (the scheme is of first order)."""
    true = ball()
    error = np.abs(distances(slope * true, LO, CELL) - true) / CELL
    assert error[np.abs(true) < CELL].max() < 0.05
    assert error[np.abs(true) < 5 * CELL].max() < 0.25


@pytest.mark.parametrize("direction", [(1, 0, 0), (1, 1, 0), (1, 2, 3), (-3, 0.2, 1)])
def test_slopes_that_differ_from_place_to_place(direction: tuple[float, float, float]) -> None:
    """The slope of the values is .7 to 1.4 along the surface; the surface stays, and the distance has slope 1."""
    true = plane(direction)
    values = true * np.exp(0.35 * np.sin(30 * X[..., 1]))
    found = distances(values, LO, CELL)
    inner = (slice(4, -4),) * 3
    near = np.abs(true[inner]) < CELL
    assert np.abs(found[inner] - true[inner])[near].max() < 0.1 * CELL
    slope = np.sqrt(sum(g**2 for g in np.gradient(found.astype(np.float64), CELL)))[inner]
    assert np.percentile(slope[np.abs(true[inner]) < 3 * CELL], [1, 99]) == pytest.approx([1, 1], abs=0.12)


def test_far_away_against_an_exact_transform() -> None:
    """Three balls apart: at up to 42 cells the distances differ from scipy's, of nodes, by at most one and a half."""
    values = np.minimum(ball(0.03, (-0.05, 0.0, 0.0)), ball(0.02, (0.055, 0.01, 0.0)))
    found = distances(np.minimum(values, ball(0.01, (0.01, 0.0, 0.0))), LO, CELL)
    solid = found < 0
    exact = np.where(solid, 0.5 - ndimage.distance_transform_edt(solid), ndimage.distance_transform_edt(~solid) - 0.5)
    assert np.abs(found / CELL - exact).max() < 1.5


def test_holes_are_filled_and_far_pieces_left_out() -> None:
    """A bubble within the ball, and a speck beside it: the surface of the ball alone is left."""
    true = ball()
    values = np.maximum(true, 0.008 - np.linalg.norm(X, axis=-1))
    values[3, 3, 3] = -0.001
    found = distances(values, LO, CELL)
    assert found[3, 3, 3] > 0 and found[NODES // 2, NODES // 2, NODES // 2] < -0.03
    assert np.abs(found - true)[np.abs(true) < CELL].max() < 0.05 * CELL


@pytest.mark.parametrize("level", [1.0, -1.0])
def test_without_a_surface_it_is_the_diagonal(level: float) -> None:
    found = distances(np.full((5, 6, 7), level), LO, CELL)
    assert np.abs(found) == pytest.approx(CELL * np.sqrt(25 + 36 + 49)) and (np.sign(found) == level).all()


def test_values_at_the_extremes_stay_finite() -> None:
    """Steps instead of slopes, of any height: the surface lies half way or nearer to a node, never beyond it."""
    solid = ball() < 0
    for height in (1e-30, 1.0, 1e30):
        found = distances(np.where(solid, -height, height), LO, CELL)
        assert np.isfinite(found).all() and ((found < 0) == solid).all()
        beside = ndimage.binary_dilation(solid) & ~solid
        assert (found[beside] <= 1.0001 * CELL).all() and found[beside].min() >= 0
    assert SLOPES[0] < 1 < SLOPES[1]
