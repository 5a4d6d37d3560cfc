"""Which pieces of a volume are kept."""

import numpy as np
import pytest

from pipeline.pieces import filled, subject_pieces

CELL = 0.01


def ball(centre: tuple[float, float, float], radius: float) -> np.ndarray:
    axis = -0.3 + CELL * np.arange(61)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) < radius


def kept(volume: np.ndarray) -> np.ndarray:
    return subject_pieces(volume, [-0.3] * 3, CELL)


def test_a_head_is_kept_though_the_torso_is_larger() -> None:
    head, torso = ball((0, 0.02, 0), 0.08), ball((0, -0.26, 0), 0.14)
    assert torso.sum() > 1.5 * head.sum() and not (head & torso).any()
    assert (kept(head | torso) & head).sum() == head.sum()


def test_halves_of_a_head_are_both_kept_and_specks_are_not() -> None:
    left, right, speck = ball((-0.06, 0, 0), 0.05), ball((0.07, 0, 0), 0.05), ball((0, 0.2, 0), 0.02)
    out = kept(left | right | speck)
    assert (out == (left | right)).all()


def test_far_from_the_origin_the_largest_counts() -> None:
    axis = 1000 + CELL * np.arange(30)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    large = np.sqrt((x - axis[8]) ** 2 + (y - axis[8]) ** 2 + (z - axis[8]) ** 2) < 0.06
    small = np.sqrt((x - axis[24]) ** 2 + (y - axis[24]) ** 2 + (z - axis[24]) ** 2) < 0.03
    out = subject_pieces(large | small, [1000.0] * 3, CELL)
    assert (out == large).all()


@pytest.mark.parametrize("volume", [np.zeros((3, 3, 3), bool), np.ones((3, 3, 3), bool)])
def test_empty_and_full_stay(volume: np.ndarray) -> None:
    assert (subject_pieces(volume, [0, 0, 0], 1.0) == volume).all()


def test_cavities_are_filled_and_pockets_are_not() -> None:
    v = np.zeros((12, 12, 12), bool)
    v[2:8, 2:8, 2:8], v[4, 4, 4], v[5, 5, 6:8] = True, False, False
    out = filled(v)
    assert out[4, 4, 4] and not out[5, 5, 7] and not out[5, 5, 6]
    assert out.sum() == 6**3 - 2
