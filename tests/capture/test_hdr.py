"""Merging of exposures: against made-up sensors whose true radiance is known, in float64."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.images import linear_of
from stages.capture import hdr


def srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, written again."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def photo(radiance: np.ndarray, exposure: float, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """8-bit sRGB of a scene at an exposure, clipped at 1; noise: of the sensor, as hdr's own constants times it."""
    rng = np.random.default_rng(seed)
    z = radiance * exposure
    z = z + noise * np.sqrt(hdr.GAIN * z + hdr.READ**2) * rng.normal(size=z.shape)
    return np.rint(255 * srgb(z)).astype(np.uint8)


def scene(h: int = 120, w: int = 160, top: float = 8.0) -> np.ndarray:
    """Radiance (h, w, 3) from 0.002 to `top`, with texture."""
    rng = np.random.default_rng(3)
    ramp = np.geomspace(0.002, top, w)[None, :, None] * np.array([1.0, 0.9, 0.8])
    fine = cv2.GaussianBlur(rng.normal(size=(h, w)).astype(np.float32), (0, 0), 1.5)[..., None]
    return np.asarray(ramp * np.exp(0.6 * fine / fine.std() * 0.3), np.float64)


EXPOSURES = (1.0, 1 / 16, 4.0)


def test_the_range_is_that_of_all_exposures() -> None:
    """One photo clips half of the scene and rounds its dark end to a few levels; the merged one does neither."""
    true = scene()
    made = hdr.merge([photo(true, e) for e in EXPOSURES], EXPOSURES)
    assert not made.clipped[:, 4:-12].any()
    inside = (slice(None), slice(4, -12))
    off = np.abs(made.radiance / true - 1)[inside]
    assert np.quantile(off, 0.95) < 0.03
    alone = linear_of(photo(true, 1.0))
    assert (np.abs(alone / true - 1)[inside] > 0.03).mean() > 0.2  # what one photo does


def test_it_is_as_good_as_the_best_unbiased_estimate() -> None:
    """The variance of many made-up sensors against 1 / sum of the inverse variances, and no bias in the dark."""
    for level in (0.003, 0.05, 0.4):
        true = np.full((200, 200, 3), level)
        exposures = (1.0, 2.0, 0.5)
        stacks = [true * e for e in exposures]
        rng = np.random.default_rng(1)
        noisy = [(z + np.sqrt(hdr.GAIN * z + hdr.READ**2) * rng.normal(size=z.shape)).astype(np.float32)
                 for z in stacks]  # fmt: skip
        made = hdr.merge(noisy, exposures).radiance.astype(np.float64)
        best = 1 / sum(e * e / (hdr.GAIN * level * e + hdr.READ**2) for e in exposures)
        assert made.mean() == pytest.approx(level, rel=0.004)
        assert made.var() == pytest.approx(best, rel=0.05)


def test_variance_of_rounding_is_that_of_rounded_values() -> None:
    """Oracle: linear values spread over some levels of 8-bit sRGB, rounded and decoded."""
    rng = np.random.default_rng(0)
    for z in (0.001, 0.02, 0.5):
        values = z * rng.uniform(0.9, 1.1, 200_000)
        code = np.rint(255 * srgb(values)) / 255
        back = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
        rounding = float(hdr.variance(np.float32(z), 255) - hdr.variance(np.float32(z), 0))
        assert np.var(back - values) == pytest.approx(rounding, rel=0.25)
    assert np.isfinite(hdr.variance(np.array([0.0, 1.0], np.float32), 255)).all()


def test_clipped_where_every_exposure_is_and_a_lower_limit_there() -> None:
    true = np.full((40, 40, 3), 0.3)
    true[10:20, 10:20] = 50.0
    made = hdr.merge([photo(true, e) for e in EXPOSURES], EXPOSURES)
    expected = np.zeros((40, 40), bool)
    expected[10:20, 10:20] = True
    assert (made.clipped == expected).all()
    assert made.radiance[15, 15] == pytest.approx(16.0)  # 1 / (1/16)
    assert np.abs(made.radiance[~expected] / 0.3 - 1).max() < 0.02


def test_black_stays_finite() -> None:
    made = hdr.merge([np.zeros((8, 8, 3), np.uint8)] * 2, (1.0, 4.0))
    assert (made.radiance == 0).all() and not made.clipped.any()


def test_a_small_shift_is_found_and_taken_back() -> None:
    true = scene(240, 320, 0.5)
    moved = cv2.warpAffine(true, np.array([[1, 0, 3.0], [0, 1, -2.0]]), (320, 240), borderMode=cv2.BORDER_REFLECT)
    base, other = photo(true, 1.0), photo(moved, 0.5)
    found = hdr.compare(base, other, 0.5)
    assert found.same and found.shift == pytest.approx((3.0, -2.0), abs=0.3)
    made = hdr.merge([base, other], (1.0, 0.5), [(0.0, 0.0), found.shift])
    inside = (slice(8, -8), slice(30, -30))
    assert np.quantile(np.abs(made.radiance / true - 1)[inside], 0.9) < 0.06
    without = hdr.merge([base, other], (1.0, 0.5))
    errors = [float(np.abs(m.radiance / true - 1)[inside].mean()) for m in (made, without)]
    assert errors[0] < 0.6 * errors[1]


def test_what_moved_and_what_is_not_as_bright_as_it_says() -> None:
    true = scene(240, 320, 0.5)
    base = photo(true, 1.0)
    still = hdr.compare(base, photo(true, 0.5, noise=1.0, seed=4), 0.5)
    assert still.same and still.shift == (0.0, 0.0) and abs(still.stops) < 0.05
    turned = true.copy()
    turned[60:180, 100:220] = true[60:180, 130:250][:, ::-1]
    assert not hdr.compare(base, photo(turned, 0.5), 0.5).same
    wrong = hdr.compare(base, photo(true, 0.5), 0.25)
    assert not wrong.same and wrong.stops == pytest.approx(1.0, abs=0.05)
    assert not hdr.compare(base, photo(true, 1e-4), 1e-4).known  # a black frame tells nothing
    far = hdr.compare(base, photo(np.roll(true, 60, 0), 0.5), 0.5)
    assert not far.same
