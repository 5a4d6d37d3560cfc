"""The compiled loops by which `neuface bench machine` measures a machine: one of look-ups, one that vectorises."""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

OPERATIONS = 17  # arithmetic of one sample: 4 of the way, 2 of the fractions, 9 of the interpolation, 2 of the sum
DEGREE = 16  # of the polynomial: 2 DEGREE operations for one value


@njit(parallel=True, error_model="numpy", cache=True)
def samples(picture, count, out):
    """Sums of `count` bilinear samples of a square picture (N, N), on lines with another slope for each entry of out;
    no sample depends on the one before it, as in the loops of stereo, of the signed distance and of the maps."""
    last, half = np.float32(picture.shape[0] - 2), np.float32(0.5)
    for task in prange(len(out)):
        total, x, y = np.float32(0.0), np.float32(task), np.float32(0.5 * task)
        step_x, step_y = np.float32(0.618 + 0.001 * task), np.float32(0.382 + 0.001 * task)
        for _ in range(count):
            x, y = x + step_x, y + step_y
            x, y = x if x < last else x - last, y if y < last else y - last
            column, row = int(x), int(y)
            fx, fy = x - np.float32(column), y - np.float32(row)
            upper = picture[row, column] + fx * (picture[row, column + 1] - picture[row, column])
            lower = picture[row + 1, column] + fx * (picture[row + 1, column + 1] - picture[row + 1, column])
            total += half * (upper + fy * (lower - upper))
        out[task] = total


@njit(parallel=True, error_model="numpy", cache=True)
def polynomials(x, out, rounds):
    """A polynomial by Horner's rule of each value of x (T, N), `rounds` times: rows stay in the cache, and the loop
    over them uses the whole width of the vector unit, as filters and sums over lamps do."""
    for task in prange(len(x)):
        for turn in range(rounds):
            a, b = np.float32(0.5 + 0.001 * turn), np.float32(0.25)
            for i in range(x.shape[1]):
                value, sample = b, x[task, i]
                for _ in range(DEGREE):
                    value = value * sample + a
                out[task, i] = value
