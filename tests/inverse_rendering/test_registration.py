"""Registration of a photo to the model: the demo's head after known motions, exact cameras, and photos without
evidence."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.maths.rigid_motion import motion_matrix
from pipeline.transforms import F64, apply
from stages.inverse_rendering import registration
from stages.inverse_rendering.registration import NOTHING, Pair, register, tukey, tukey_cost
from tests.support.posed_head import pair

REST = np.zeros(6)
# turn in radians and shift in metres: half a pixel to three pixels (1.3 mm each) of a head of 110 pixels
MOTIONS = [
    np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0]),
    np.array([0.012, -0.008, 0.01, 0.001, -0.0015, 0.002]),
    np.array([-0.01, 0.03, 0.005, 0.002, 0.001, -0.004]),
]


def off(p: Pair, found: F64, true: F64) -> float:
    """Root mean square distance in blocks of the points after the found and after the true motion."""
    x = p.x[p.usable]
    apart = p.seen(apply(motion_matrix(found), x)) - p.seen(apply(motion_matrix(true), x))
    return float(np.sqrt((apart**2).sum(1).mean()))


@pytest.mark.parametrize("true", MOTIONS)
@pytest.mark.parametrize("azimuth", [0.0, 50.0])
def test_known_motions_of_the_demos_head_are_found(true: F64, azimuth: float) -> None:
    p = pair(azimuth, true)
    found = register(p)
    assert found.better
    assert off(p, REST, true) > 0.3
    limit = 0.04 + 0.015 * off(p, REST, true)
    assert off(p, found.xi, true) < limit
    assert all(off(p, half, true) < 1.5 * limit for half in found.halves)
    np.testing.assert_allclose(found.pixels(found.xi), off(p, REST, true), rtol=0.1)
    assert found.noise < 0.01 < 0.08 < found.signal


def test_exact_cameras_stay() -> None:
    p = pair(20.0, REST)
    found = register(p)
    assert found.pixels(found.xi) < 0.04
    assert abs(found.signal) < 0.002


def test_exposure_and_veil_of_the_photo_do_not_move_it() -> None:
    p = pair(20.0, MOTIONS[0])
    changed = replace(p, photo=(0.7 * p.photo + 0.1).astype(np.float32))
    assert off(p, register(changed).xi, MOTIONS[0]) < 0.06


def test_a_hand_before_the_face_is_an_outlier() -> None:
    p = pair(0.0, MOTIONS[1])
    photo = p.photo.copy()
    photo[100:130, 70:110] = 0.6
    assert off(p, register(replace(p, photo=photo)).xi, MOTIONS[1]) < 0.1


def test_silhouettes_alone_tell_a_shift() -> None:
    shift = np.array([0, 0, 0, 0.003, 0.002, 0])
    p = pair(0.0, shift)
    flat = np.full_like(p.photo, 0.5)
    found = register(replace(p, photo=flat, model=flat))
    x = p.x[p.usable]
    moved = p.seen(apply(motion_matrix(found.xi), x)) - p.seen(x)
    wanted = p.seen(apply(motion_matrix(shift), x)) - p.seen(x)
    np.testing.assert_allclose(moved.mean(0), wanted.mean(0), atol=0.6)
    assert not found.better, "no unused pixel confirms it"


def test_colours_alone_find_the_motion() -> None:
    p = pair(0.0, MOTIONS[1], outline=False)
    assert off(p, register(p).xi, MOTIONS[1]) < 0.06


def test_the_rows_of_the_system_are_finite_differences_of_the_residuals() -> None:
    """At the true motion of a smooth picture, where photo and model have one gradient."""
    p = pair(0.0, REST, noise=0.0)
    smooth = np.asarray(cv2.GaussianBlur(p.model, (0, 0), 6.0), np.float32)
    p = replace(p, photo=smooth, model=smooth)
    for side in (1, 2):
        level, h = registration._level(p, side), 1e-4

        def residual(six: F64, level: registration._Level = level) -> F64:
            return registration._value(level, registration._moved(p, level, six)[1]) - level.m

        wanted = np.stack([(residual(h * e) - residual(-h * e)) / (2 * h) for e in np.eye(6)], -1)
        found = np.einsum("nk,nkj->nj", level.gradient / level.side, p.slope(level.x))
        np.testing.assert_allclose(found, wanted, atol=0.04 * np.abs(wanted).max())
        H, g = registration._colours(p, level, REST)
        s = registration.SMALLEST  # residuals are 0: every weight is 1
        np.testing.assert_allclose(g, 0, atol=1e-2)
        np.testing.assert_allclose(H, found.T @ found * side**2 / (s * s * registration.ALIKE), rtol=1e-6)


def test_tukeys_weight_is_the_slope_of_its_cost() -> None:
    u, h = np.linspace(-5, 5, 201), 1e-6
    slope = (tukey_cost(u + h) - tukey_cost(u - h)) / (2 * h)
    np.testing.assert_allclose(slope, 6 / registration.TUKEY**2 * tukey(u) * u, atol=1e-6)
    assert tukey_cost(np.array([0.0, 4.0, 1e9])).tolist() == [0, 1, 1]


# ------------------------------------------------------------------ extremes
def test_photos_without_evidence_move_nothing() -> None:
    p = pair(0.0, MOTIONS[0])
    nothing = replace(p, usable=np.zeros_like(p.usable), outline=None)
    assert register(nothing) == NOTHING
    few = np.zeros_like(p.usable)
    few[90:96, 90:96] = p.usable[90:96, 90:96]
    assert register(replace(p, usable=few)) == NOTHING
    assert not NOTHING.better


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_left_out(value: float) -> None:
    p = pair(0.0, MOTIONS[0])
    photo, model = p.photo.copy(), p.model.copy()
    photo[60:80, 60:80] = value
    model[110:120, 80:90] = value
    assert off(p, register(replace(p, photo=photo, model=model)).xi, MOTIONS[0]) < 0.1
    assert register(replace(p, photo=np.full_like(p.photo, value))) == NOTHING
    assert register(replace(p, cam_from_world=np.full((4, 4), value))) == NOTHING


def test_no_texture_and_no_outline_move_nothing() -> None:
    p = pair(0.0, MOTIONS[0], outline=False)
    flat = np.full_like(p.photo, 0.5)
    found = register(replace(p, photo=flat, model=flat))
    assert found.pixels(found.xi) < 1e-6
    assert not found.better


def test_noise_alone_is_not_confirmed() -> None:
    p = pair(0.0, REST, outline=False)
    noise = np.random.default_rng(2).random(p.photo.shape).astype(np.float32)
    found = register(replace(p, photo=noise))
    assert found.gain < 0.02


def test_a_motion_that_is_too_large_is_not_used() -> None:
    found = register(pair(0.0, MOTIONS[1]))
    grown = registration.FARTHEST / found.pixels(found.xi)
    assert replace(found, xi=0.99 * grown * found.xi).better
    assert not replace(found, xi=1.01 * grown * found.xi).better


def test_an_unsure_gain_does_not_confirm_a_motion() -> None:
    found = replace(NOTHING, gain=0.03, error=0.02)
    assert found.better and not replace(found, gain=0.01).better and not replace(found, gain=0.0).better


@pytest.mark.parametrize("side", [1, 2, 4])
def test_the_halves_are_the_colours_of_a_chessboard(side: int) -> None:
    """Both halves have all rows and all columns, so that neither sees a motion that the other does not."""
    level = registration._level(pair(0.0, REST, outline=False), side)
    column, row = (level.at * side // registration.SQUARE).astype(int).T
    np.testing.assert_array_equal(level.half == 1, (row % 2 == 1) != (column % 2 == 1))
    for line in (row, column):
        assert all(len(set(level.half[line == k])) == 2 for k in set(line) if (line == k).sum() > 30 * 16 / side)


def test_the_motion_is_the_least_sum_of_evidence_and_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a squared residual H (xi - t)^2 the minimum with 6 xi^T G xi / d^2 is (H + 6 G / d^2)^-1 H t."""
    p = pair(0.0, REST, outline=False)
    levels = [registration._level(p, side) for side in registration.LEVELS]
    G, H = np.diag([3.0, 3.0, 3.0, 1.0, 2.0, 4.0]), np.diag([1.0, 1.0, 1.0, 0.5, 1.0, 2.0])
    target = np.array([0, 0, 0, 0.3, -0.2, 0.1])
    monkeypatch.setattr(registration, "_colours", lambda pair, level, xi: (H, H @ (xi - target)))
    found = registration._solve(p, levels, G, 0)
    expected = np.diag(H) / (np.diag(H) + 6 * np.diag(G) / 4.0**2) * target
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("size", [0.01, 1.0])
def test_the_robust_deviation_is_that_of_a_normal_distribution(size: float) -> None:
    r = size * np.random.default_rng(7).standard_normal(20_000)
    r[:1000] = 1e3  # one in twenty is wrong
    assert registration.scale_of(r) == pytest.approx(size, rel=0.1)
    assert registration.scale_of(np.zeros(9)) == registration.SMALLEST
