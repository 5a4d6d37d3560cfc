"""Clipped pixels as inequalities, from the photo to the batch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.inverse_rendering.ray_sampling import PixelTable, bounds_of
from tests.support.small_ball import ball_view


def test_which_means_are_only_limits() -> None:
    """A wholly clipped block whose blue is far below the limit; a partly clipped one; a black one; a usual one."""
    rgb = np.array([[[1.0, 0.95, 0.3], [0.6, 0.5, 0.4], [0.0, 0.0, 0.2], [0.5, 0.4, 0.3]]], np.float32)
    clipped = np.array([[1.0, 0.25, 0.0, 0.0]], np.float32)
    assert bounds_of(rgb, clipped).tolist() == [[[1, 1, 0], [1, 1, 1], [-1, -1, 0], [0, 0, 0]]]
    black = [[[0, 0, 0], [0, 0, 0], [-1, -1, 0], [0, 0, 0]]]
    assert bounds_of(rgb, None).tolist() == black == bounds_of(rgb, np.zeros_like(clipped)).tolist()


def test_the_limit_is_that_of_the_photos_exposure() -> None:
    """Photos are divided by their exposures, so that the largest value is not 1."""
    rgb = np.array([[[1.0, 0.95, 0.3]]], np.float32)
    clipped = np.ones((1, 1), np.float32)
    for exposure in (0.1, 1.0, 7.0):
        assert bounds_of(rgb / np.float32(exposure), clipped).tolist() == [[[1, 1, 0]]]


def test_clipped_pixels_of_the_subject_are_drawn() -> None:
    """With their limit; those of the background have one, too, which nothing reads."""
    view = ball_view(0)
    clipped = np.zeros_like(view.alpha)
    clipped[28:36, 28:36] = 1
    rgb = view.rgb.copy()
    rgb[28:36, 28:36] = 1
    table = PixelTable([replace(view, rgb=rgb, clipped=clipped)], 64, "cpu")
    assert len(table.inside) == int((view.alpha > 0.5).sum())
    found = table.bound[table.inside]
    assert int((found == 1).all(1).sum()) == 64 and not bool((found > 0).any(1).sum() > 64)
    batch = table.at(table.inside)
    assert np.array_equal(batch.bound.numpy(), found.numpy()) and (batch.target[found[:, 0] == 1] == 1).all()
