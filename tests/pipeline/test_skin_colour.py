"""How far a colour is from that of a face."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.colour import LUMA
from pipeline.skin_colour import ALIKE, FLOOR, LEAST, against_face

FACE = np.array([0.5, 0.3, 0.2])


def spread(sigma: float, count: int = 4001) -> np.ndarray:
    """A face whose luminance alone varies, with this standard deviation of the logarithm."""
    return FACE * np.exp(sigma * np.random.default_rng(0).standard_normal((count, 1)))


@pytest.mark.parametrize("gain", [0.02, 1.0, 1.9])
def test_spreads_are_those_of_the_logarithms(gain: float) -> None:
    """By hand: an even face, so that the floors are the spreads; a factor on one channel moves y, r and b."""
    off = against_face(gain * np.tile(FACE, (60, 1)), gain * np.array([FACE, FACE * [1.2, 1, 1], 0.7 * FACE]))[1]
    luminance = np.log((FACE * [1.2, 1, 1]) @ np.array(LUMA) / (FACE @ np.array(LUMA)))
    np.testing.assert_allclose(off[0], 0, atol=1e-6)
    np.testing.assert_allclose(off[1], np.hypot(luminance / FLOOR[0], np.log(1.2) / FLOOR[1]), rtol=1e-6)
    np.testing.assert_allclose(off[2], -np.log(0.7) / FLOOR[0], rtol=1e-6)


def test_a_face_that_varies_more_allows_more_but_its_brows_do_not() -> None:
    """The spread of a face is its own above the floor; a tenth of brows in it changes hardly anything."""
    face = spread(0.4)
    at = FACE * np.exp(-0.8)
    assert against_face(face, at[None])[1][0] == pytest.approx(2, rel=0.05)
    face[:400] = 0.05 * FACE
    assert against_face(face, at[None])[1][0] == pytest.approx(2, abs=0.3)


def test_what_is_darker_than_a_third_is_dark_and_black_is_finite() -> None:
    bright, off = against_face(spread(0.1), np.array([0.4 * FACE, 0.3 * FACE, np.zeros(3), np.full(3, LEAST / 2)]))
    assert bright.tolist() == [True, False, False, False]
    assert np.isfinite(off).all() and (off[2:] > ALIKE).all() and off[2] == pytest.approx(off[3])
    assert [len(part) for part in against_face(FACE[None], np.zeros((0, 3)))] == [0, 0]
