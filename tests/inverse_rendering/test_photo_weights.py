"""Which parts of which photos get a low weight: simulated residuals of a ball, with error rates over 20 seeds."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from stages.inverse_rendering.photo_weights import (
    CELLS,
    FACINGS,
    LEAST,
    LOW,
    Residuals,
    Weights,
    _medians,
    all_alike,
    expected_residuals,
    weigh,
)

F64 = npt.NDArray[np.float64]
VIEWS, RAYS, SEEDS = 24, 6000, 20  # rays of a photo in the last 200 steps of a draft with 80 photos
NOISE = np.full(VIEWS, 0.01)
STILL = np.zeros((VIEWS, CELLS, CELLS))
BLOCK = slice(12, 18)  # cells, in rows and columns: 3.5 % of a photo
OCCLUDED, BAD = 5, 9


@cache
def ball(seed: int) -> tuple[Residuals, F64, npt.NDArray[np.int64]]:
    """Residuals of photos around a ball of radius 1 that differ from place to place, and grow by 2.5 times towards the
    contour, as those of fits do. Also the points (N, 3), and the cells' rows and columns (N, 2)."""
    rng = np.random.default_rng(seed)
    view = np.repeat(np.arange(VIEWS), RAYS)
    angle, radius = rng.uniform(0, 2 * np.pi, len(view)), np.sqrt(rng.uniform(0, 1, len(view)))
    u, w = radius * np.cos(angle), radius * np.sin(angle)
    z = np.sqrt(np.maximum(1 - u * u - w * w, 0))
    turn = 2 * np.pi * view / VIEWS
    x = np.stack([u * np.cos(turn) + z * np.sin(turn), w, z * np.cos(turn) - u * np.sin(turn)], -1)
    usual = 0.03 * (1.5 + np.sin(4 * x[:, 0]) * np.sin(5 * x[:, 1])) * (2.5 - 1.5 * z)
    of_view = np.exp(0.1 * rng.standard_normal(VIEWS))
    residual = usual * of_view[view] * np.abs(rng.standard_normal(len(view)))
    at = np.minimum(((x + 1) / 2 * 24).astype(np.int64), 23)
    place = (at[:, 0] * 24 + at[:, 1]) * 24 + at[:, 2]
    cells = np.minimum((np.stack([w, u], -1) + 1) / 2 * CELLS, CELLS - 1).astype(np.int64)
    facing = np.minimum((z * FACINGS).astype(np.int64), FACINGS - 1)
    return Residuals(residual, place, facing, view, cells[:, 0] * CELLS + cells[:, 1]), x, cells


def with_residual(seen: Residuals, residual: F64) -> Residuals:
    return Residuals(residual, seen.place, seen.facing, seen.view, seen.cell)


def occluded(seed: int) -> Residuals:
    """Something covers a block of one photo."""
    seen, _, cells = ball(seed)
    there = (seen.view == OCCLUDED) & ((cells >= BLOCK.start) & (cells < BLOCK.stop)).all(1)
    painted = np.abs(0.3 + 0.05 * np.random.default_rng(seed).standard_normal(len(there)))
    return with_residual(seen, np.where(there, painted, seen.residual))


def low_share(found: Weights) -> float:
    """Share of the cells with rays that have a low weight."""
    return float((found.table < LOW)[found.rays > 0].mean())


# ------------------------------------------------------------------ what must and must not fall
def test_photos_that_agree_keep_their_weight() -> None:
    shares = [low_share(weigh(ball(s)[0], NOISE, STILL)) for s in range(SEEDS)]
    assert np.mean(shares) < 0.002 and max(shares) < 0.005
    lowest = [weigh(ball(s)[0], NOISE, STILL).of_photos()[0].min() for s in range(SEEDS)]
    assert min(lowest) > 0.6


def test_what_covers_a_part_of_one_photo_gets_a_low_weight_and_nothing_else() -> None:
    hits, others = [], []
    for seed in range(SEEDS):
        found = weigh(occluded(seed), NOISE, STILL)
        low = found.table < LOW
        hits.append(low[OCCLUDED, BLOCK, BLOCK].mean())
        low[OCCLUDED, BLOCK.start - 1 : BLOCK.stop + 1, BLOCK.start - 1 : BLOCK.stop + 1] = False  # smoothed cells
        others.append(low[found.rays > 0].mean())
    assert min(hits) > 0.9 and np.mean(hits) > 0.98
    assert np.mean(others) < 0.002 and max(others) < 0.005


def test_a_photo_that_is_wrong_as_a_whole_gets_a_low_weight() -> None:
    for seed in range(SEEDS):
        seen = ball(seed)[0]
        found = weigh(with_residual(seen, np.where(seen.view == BAD, 4, 1) * seen.residual), NOISE, STILL)
        mean, low = found.of_photos()
        others = np.delete(mean, BAD)
        assert found.view[BAD] < 0.3 and mean[BAD] < 0.3 and low[BAD] > 0.9
        assert others.min() > 0.6


def test_wrong_surface_keeps_its_weight_where_all_photos_see_that_it_is_wrong() -> None:
    """Eight times the residual on a quarter of the ball, in every photo of it."""
    shares = []
    for seed in range(SEEDS):
        seen, x, _ = ball(seed)
        wrong = (x[:, 1] > 0.2) & (x[:, 2] > 0)
        found = weigh(with_residual(seen, np.where(wrong, 8, 1) * seen.residual), NOISE, STILL)
        shares.append(low_share(found))
    assert np.mean(shares) < 0.01 and max(shares) < 0.02


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_fit_that_is_wrong_everywhere_has_no_low_weights(factor: float) -> None:
    seen = ball(0)[0]
    found = weigh(with_residual(seen, factor * seen.residual), NOISE / 100, STILL)
    assert low_share(found) < 0.005
    if factor < 1:  # below LARGEST nothing depends on the unit
        same = weigh(seen, NOISE / 10, STILL)
        np.testing.assert_allclose(found.table, same.table, atol=0.02)


def test_residuals_below_the_noise_are_not_held_against_a_photo() -> None:
    """A photo with three times the residual of the others, but within its own noise."""
    seen = ball(1)[0]
    residual = np.where(seen.view == BAD, 3, 1) * seen.residual
    noise = np.where(np.arange(VIEWS) == BAD, 0.5, 0.01)
    assert weigh(with_residual(seen, residual), noise, STILL).of_photos()[0][BAD] > 0.95
    assert weigh(with_residual(seen, residual), NOISE, STILL).of_photos()[0][BAD] < 0.5


def test_labels_of_what_moves_lower_it_further() -> None:
    seen, _, cells = ball(2)
    there = (seen.view == OCCLUDED) & ((cells >= BLOCK.start) & (cells < BLOCK.stop)).all(1)
    worse = with_residual(seen, np.where(there, 5, 1) * seen.residual)
    inside = OCCLUDED, BLOCK, BLOCK
    plain = weigh(worse, NOISE, STILL).table[inside].mean()
    moves = weigh(worse, NOISE, np.ones_like(STILL)).table[inside].mean()
    assert LEAST < moves < 0.85 * plain


# ------------------------------------------------------------------ the expected residual
def test_the_expected_residual_is_the_median_of_the_photos_by_hand() -> None:
    """One place, seen by five photos with 1, 2, 3, 4, 50 times .01: the median of their means is .03."""
    times = np.repeat([1, 2, 3, 4, 50], 4)
    zero = np.zeros(20, np.int64)
    seen = Residuals(0.01 * times, zero, zero, np.repeat(np.arange(5), 4), zero)
    np.testing.assert_allclose(expected_residuals(seen, seen.residual, np.zeros(5)), 0.03)
    np.testing.assert_allclose(expected_residuals(seen, seen.residual, np.full(5, 0.1)), 0.1 * np.sqrt(2 / np.pi))


def test_medians_of_groups_are_numpys() -> None:
    rng = np.random.default_rng(0)
    group, values = rng.permutation(np.repeat(np.arange(12), np.arange(12))), rng.standard_normal(66)
    found = _medians(group, values, 12)
    assert np.isnan(found[:4]).all()  # fewer than four values
    np.testing.assert_array_equal(found[4:], [np.median(values[group == g]) for g in range(4, 12)])


def test_where_too_few_photos_show_a_place_nothing_is_expected() -> None:
    view = np.repeat(np.arange(3), 4)
    zero = np.zeros(12, np.int64)
    seen = Residuals(np.linspace(0.01, 0.5, 12), zero, zero, view, zero)
    assert np.isnan(expected_residuals(seen, seen.residual, np.zeros(3))).all()
    np.testing.assert_array_equal(weigh(seen, np.zeros(3), np.zeros((3, CELLS, CELLS))).table, 1.0)


# ------------------------------------------------------------------ extremes
@pytest.mark.parametrize("value", [0.0, 1.0, np.inf, np.nan])
def test_the_same_residual_everywhere(value: float) -> None:
    seen = ball(0)[0]
    found = weigh(with_residual(seen, np.full_like(seen.residual, value)), np.zeros(VIEWS), STILL)
    np.testing.assert_allclose(found.table, 1.0)


def test_one_infinite_residual_changes_its_neighbourhood_at_most() -> None:
    seen = ball(0)[0]
    residual = seen.residual.copy()
    residual[100] = np.inf
    found, usual = weigh(with_residual(seen, residual), NOISE, STILL).table, weigh(seen, NOISE, STILL).table
    assert np.isfinite(found).all() and (np.abs(found - usual) > 0.05).sum() <= 9


def test_one_ray_one_cell_and_no_ray() -> None:
    for n in (0, 1, 2):
        zero = np.zeros(n, np.int64)
        found = weigh(Residuals(np.full(n, 0.1), zero, zero, zero, zero), np.zeros(1), np.zeros((1, CELLS, CELLS)))
        np.testing.assert_array_equal(found.table, 1.0)
        np.testing.assert_array_equal(found.of_photos(), [[1.0], [0.0]])


def test_weights_stay_within_their_limits() -> None:
    seen = ball(3)[0]
    found = weigh(with_residual(seen, np.where(seen.view % 4 == 0, 1.0, 1e-6)), np.zeros(VIEWS), STILL + 1.0)
    assert found.table.min() >= LEAST and found.table.max() <= 1
    mean, low = found.of_photos()
    assert (
        (mean[::4] < 0.5).all()
        and (np.delete(mean, slice(None, None, 4)) > 0.9).all()
        and (low >= 0).all()
        and (low <= 1).all()
    )


def test_without_any_weighing_all_count_alike() -> None:
    mean, low = all_alike(3).of_photos()
    assert mean.tolist() == [1, 1, 1] and low.tolist() == [0, 0, 0]
