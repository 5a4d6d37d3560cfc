"""The field of departures on a ball: against the closed form of one vertex, and where photos say nothing."""

from __future__ import annotations

import numpy as np
import pytest
from support.synthetic_asset import ball

from pipeline.meshes import Mesh
from stages.bake.gloss_field import LENGTH, Slopes, Spread, common, departures

SPREAD = Spread(0.008, 0.05, -0.8)
HALFWAY = 0.01  # variance at which the prior and the photos count alike


def small_ball(radius: float) -> Mesh:
    """So small that all of it is one place, or as large as a head."""
    made = ball(24, 12, height=1.0)
    x = made["vertices"] / np.linalg.norm(made["vertices"], axis=1).max() * radius
    return Mesh(x.astype(np.float32), x.astype(np.float32), made["faces"])


def sums(count: int, xx: float, xz: float, zz: float, xy: float, zy: float, yy: float) -> Slopes:
    return Slopes(*(np.full(count, v) for v in (xx, xz, zz, xy, zy, yy, 30.0)))


def test_nothing_departs_where_photos_say_nothing() -> None:
    mesh = small_ball(0.1)
    count = len(mesh.vertices)
    for own in (np.zeros(count, bool), np.ones(count, bool)):
        u, v = departures(mesh, own, sums(count, 0, 0, 0, 0, 0, 1), 0.03, SPREAD)
        assert (u == 0).all() and (v == 0).all()


def test_exact_photos_are_followed_and_noise_is_not() -> None:
    """y = (m + u) x + v z with u = .004, v = -.03, and the same under much noise."""
    mesh = small_ball(0.1)
    count, m, u, v = len(mesh.vertices), 0.03, 0.004, -0.03
    xx, xz, zz = 10.0, 0.5, 0.05
    xy, zy = (m + u) * xx + v * xz, (m + u) * xz + v * zz
    exact = (m + u) * xy + v * zy
    own = np.ones(count, bool)
    found = departures(mesh, own, sums(count, xx, xz, zz, xy, zy, exact), m, SPREAD)
    assert np.median(found[0]) == pytest.approx(u, rel=0.05) and np.median(found[1]) == pytest.approx(v, rel=0.1)
    half = departures(mesh, own, sums(count, xx, xz, zz, xy, zy, exact + HALFWAY), m, SPREAD)
    assert 0.2 * u < np.median(half[0]) < 0.8 * u  # nearly all of it if errors were not common to neighbours
    noisy = departures(mesh, own, sums(count, xx, xz, zz, xy, zy, exact + 100.0), m, SPREAD)
    assert np.abs(noisy[0]).max() < 0.2 * u and np.abs(noisy[1]).max() < -0.2 * v


def test_what_few_places_tell_goes_on_over_the_length_and_no_further() -> None:
    mesh = small_ball(0.1)
    count = len(mesh.vertices)
    own = mesh.vertices[:, 1] > 0.085
    u, _ = departures(mesh, own, sums(count, 1e4, 0, 0, 1e4 * 0.036, 0, 1e4 * 0.036**2 + 1e-9), 0.03, SPREAD)
    near = own | (np.abs(mesh.vertices[:, 1] - 0.085) < LENGTH / 2)
    assert np.median(u[own]) == pytest.approx(0.006, rel=0.2)
    assert u[near].min() > 0.001 and np.abs(u[mesh.vertices[:, 1] < 0]).max() < 0.0005


def test_gloss_and_roughness_are_drawn_together() -> None:
    """Photos that tell F0 alone lower the roughness, by the regression of the prior: c s_v / s_u."""
    mesh = small_ball(0.1)
    count = len(mesh.vertices)
    own = np.ones(count, bool)
    u, v = departures(mesh, own, sums(count, 1e5, 0, 0, 1e5 * 0.034, 0, 1e5 * 0.034**2), 0.03, SPREAD)
    assert np.median(u) == pytest.approx(0.004, rel=0.05)
    assert np.median(v / u) == pytest.approx(-0.8 * 0.05 / 0.008, rel=0.02)


def test_observations_within_a_length_count_as_few() -> None:
    assert common(np.full(9, LENGTH**2 / 100)) == pytest.approx(100 * common(np.full(9, LENGTH**2)))
    assert common(np.full(9, 10 * LENGTH**2)) == common(np.full(9, LENGTH**2))
