"""The smoothest function near given values: against dense least squares, and against the attenuation of a ripple."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from stages.inverse_rendering.smoothest import laplacian, smoothest


def test_it_is_the_least_squares_solution() -> None:
    """Against a dense matrix that is made from the definition, node by node."""
    rng = np.random.default_rng(0)
    around, inside = rng.normal(size=(5, 6, 4)), rng.random((5, 6, 4)) < 0.6
    inside[0, 0, 0] = True  # a node of a corner
    node = [tuple(int(i) for i in p) for p in np.argwhere(inside)]
    weight, target = rng.random(len(node)) + 0.05, rng.normal(size=len(node))
    rows, right = [], []
    for p in node:
        row, known = np.zeros(len(node)), 0.0
        for axis in range(3):
            for step in (-1, 1):
                q = tuple(c + step * (a == axis) for a, c in enumerate(p))
                if not all(0 <= c < n for c, n in zip(q, inside.shape, strict=True)):
                    continue
                row[node.index(p)] -= 1
                if inside[q]:
                    row[node.index(q)] += 1
                else:
                    known += around[q]
        rows.append(row)
        right.append(-known)
    a = np.concatenate([np.diag(np.sqrt(weight)), np.array(rows)])
    b = np.concatenate([np.sqrt(weight) * target, np.array(right)])
    expected = np.linalg.lstsq(a, b, rcond=None)[0]
    found = smoothest(inside, around, weight, target, target, iterations=2000)
    assert found == pytest.approx(expected, abs=2e-3)
    operator = laplacian(inside, around)
    assert np.stack([operator(unit) for unit in np.eye(len(node))], 1) == pytest.approx(np.array(rows))
    assert operator.squared_diagonal() == pytest.approx((np.array(rows) ** 2).sum(0))
    assert operator.border == pytest.approx(-np.array(right))


@pytest.mark.parametrize("q", [1.0, 2.0, 4.0])
def test_a_ripple_keeps_the_share_that_its_wavelength_says(q: float) -> None:
    """w / (w + k^4), with k^2 the grid's own, in the middle of a long grid; half of it at k q = 1."""
    x = np.arange(241.0)
    wave = 2 * np.pi * q
    ripple = np.broadcast_to(np.sin(2 * np.pi * x / wave)[:, None, None], (241, 3, 3)).copy()
    inside = np.ones(ripple.shape, np.bool_)
    inside[[0, -1]] = False
    w = q**-4
    start = ripple[inside]
    found = ripple.copy()
    found[inside] = smoothest(inside, ripple, np.full(len(start), w), start, start, iterations=2000)
    middle = slice(80, 160)
    share = float((found[middle, 1, 1] * ripple[middle, 1, 1]).sum() / (ripple[middle, 1, 1] ** 2).sum())
    k2 = 2 - 2 * np.cos(2 * np.pi / wave)
    assert share == pytest.approx(w / (w + k2**2), abs=0.01)
    if q >= 4:
        assert share == pytest.approx(0.5, abs=0.02)


def test_extremes() -> None:
    """A single node; weights that are huge or tiny: the target, and the mean of the neighbours."""
    around = np.zeros((3, 3, 3))
    around[0, 1, 1] = 6.0
    inside = np.zeros((3, 3, 3), np.bool_)
    inside[1, 1, 1] = True
    for weight, expected in ((1e12, 5.0), (1e-12, 1.0)):
        found = smoothest(inside, around, np.array([weight]), np.array([5.0]), np.array([5.0]))
        assert found == pytest.approx([expected], rel=1e-6)


def test_the_number_of_threads_does_not_matter() -> None:
    """The same bytes with one thread and with several: a fit repeats bit by bit."""
    rng = np.random.default_rng(1)
    around = rng.normal(size=(40, 41, 42))
    inside = np.ones(around.shape, np.bool_)
    inside[0] = False
    weight = rng.uniform(0.01, 4, int(inside.sum()))
    found = []
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        found.append(smoothest(inside, around, weight, around[inside], around[inside]).tobytes())
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert found[0] == found[1]


def test_zeros_stay_zeros() -> None:
    """Without any data the residual is 0 from the start: nothing is divided by it."""
    around = np.zeros((4, 5, 6))
    inside = np.ones(around.shape, np.bool_)
    zeros = np.zeros(around.size)
    assert (smoothest(inside, around, np.ones(around.size), zeros, zeros) == 0).all()
    assert len(smoothest(np.zeros_like(inside), around, zeros[:0], zeros[:0], zeros[:0])) == 0
