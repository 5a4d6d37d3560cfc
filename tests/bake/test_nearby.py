"""The usual colour of what photos show nearby."""

from __future__ import annotations

import numpy as np
import pytest

from stages.bake.nearby import CELL, LEAST, WIDER, nearby_colours

BLACK, PINK = np.array([0.02, 0.02, 0.03]), np.array([0.7, 0.5, 0.5])


def sheet(low: float, high: float, z: float = 0.0, step: float = 0.004) -> np.ndarray:
    """Points (N, 3) of a sheet 6 cm wide, between two heights."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-0.03, 0.03, step), np.arange(low, high, step)))
    return np.stack([x, y, np.full_like(x, z)], 1)


def test_the_back_of_hanging_hair_is_hair_and_the_back_of_a_shirt_is_shirt() -> None:
    """Seen: hair that hangs before a shirt of four times its area, from the front. The wall shines through its rim."""
    hair, shirt = sheet(0.0, 0.12), sheet(-0.5, -0.02)
    seen, colour = (
        np.concatenate([hair, shirt]),
        np.concatenate([np.tile(BLACK, (len(hair), 1)), np.tile(PINK, (len(shirt), 1))]),
    )
    colour[np.abs(seen[:, 0]) > 0.025] = 1.0
    behind = np.concatenate([sheet(0.04, 0.12, -0.03), sheet(-0.4, -0.1, -0.15)])
    found = nearby_colours(behind, seen, colour)
    of_hair = behind[:, 1] > 0
    np.testing.assert_allclose(found[of_hair], np.tile(BLACK, (of_hair.sum(), 1)), atol=1e-12)
    np.testing.assert_allclose(found[~of_hair], np.tile(PINK, ((~of_hair).sum(), 1)), atol=1e-12)


def test_it_is_the_median_over_the_surrounding() -> None:
    """Oracle: the distances of all points, one after another, at the middle of a cell far from others."""
    rng = np.random.default_rng(3)
    points, albedo = rng.uniform(-0.1, 0.1, (400, 3)), rng.uniform(size=(400, 3))
    for place in ([0.0, 0.0, 0.0], [0.2, 0.1, 0.0], [1.0, -2.0, 3.0]):
        at = (np.floor(np.array(place) / CELL) + 0.5) * CELL
        away = np.linalg.norm(points - at, axis=1)
        expected = np.median(albedo[away <= LEAST + WIDER * away.min()], axis=0)
        np.testing.assert_allclose(nearby_colours(at[None], points, albedo)[0], expected, atol=1e-12)


def test_it_changes_little_between_neighbours() -> None:
    """Along a line past the border of two colours it falls once, in steps that the smoothing of the fill takes away."""
    at = np.stack([np.zeros(2001), np.linspace(-0.1, 0.1, 2001), np.full(2001, -0.03)], 1)
    points = sheet(-0.3, 0.3)
    found = nearby_colours(at, points, (points[:, 1:2] > 0) * np.ones(3))[:, 0]
    assert found[0] < 1e-9 and found[-1] > 1 - 1e-9 and (np.diff(found) >= -1e-3).all()
    assert np.abs(np.diff(found)).max() < 0.02  # a tenth of a millimetre


@pytest.mark.parametrize("far", [1e-3, 1.0, 1e4])
def test_one_seen_point_gives_its_colour_at_any_distance(far: float) -> None:
    at = far * np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(nearby_colours(at, np.zeros((1, 3)), BLACK[None]), np.tile(BLACK, (50, 1)))
    assert nearby_colours(at[:0], np.zeros((1, 3)), BLACK[None]).shape == (0, 3)


def test_of_many_points_some_are_asked() -> None:
    points = np.random.default_rng(1).uniform(size=(60_000, 3))
    found = nearby_colours(points[:100] + 0.001, points, points)
    np.testing.assert_allclose(found, points[:100], atol=0.08)
