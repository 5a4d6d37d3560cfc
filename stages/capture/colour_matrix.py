"""The linear map that takes a photo's colours to the reflectances of the chart in it.

Symbols: c_i linear colour of patch i in the photo, r_i its reflectance, (x_i, y_i) its place on the chart; M (3, 3), or
a diagonal of three gains. Light that is uneven over the chart brightens its patches by 1 + a x + b y; then

    M c_i = r_i (1 + a x_i + b y_i)

is linear in M, a and b, and is solved with weights 1 / (Y_i + 0.1), Y_i the patch's luminance: relative errors count,
absolute ones in the dark. Every figure of quality is from patches that were left out of their own solution.

What this fixes is white balance, and the unit: M c = 1 is what a perfect white sends from the chart's place. It can't
fix the scale of the albedo, because how much light falls on the head and how much on the chart are two numbers.

Differs: the paper's captures have one camera response each, and its colours no white but that of its losses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.colour import LUMA
from stages.capture.colour_checker import F64, PATCHES, REFLECTANCES, Bool, Patches, places

DARK = 0.1
FEWEST = 14  # patches: less than that many can't be told from noise
WRONG = 0.15  # weighted error from which it is no such chart, or unusable: patches taken for others are 0.2 to 1.2 off
SIMPLER = 0.8  # nine numbers must leave at most this share of three's error
EVEN = 0.8  # |a| + |b| from which the light on the chart changes too much


@dataclass(frozen=True, slots=True)
class ColourMatrix:
    """matrix: reflectance of the chart from the photo's linear colours. way: what it was given. error: see above."""

    matrix: F64
    way: Literal["gains", "matrix"]
    error: float
    patches: int


def colour_matrix_of(found: Patches) -> ColourMatrix | str:
    """M of a chart, or why it is of no use, in words that go behind 'the colour chart'."""
    if found.usable.sum() < FEWEST:
        return f"has {int(found.usable.sum())} patches of {PATCHES} that are large enough and not clipped"
    three, nine = (_left_out(found, diagonal) for diagonal in (True, False))
    diagonal = nine > SIMPLER * three
    error = three if diagonal else nine
    if error > WRONG:
        return f"does not show the colours of a classic chart of 24 patches (they are {error:.0%} off)"
    matrix, slope = _solved(found, found.usable, diagonal)
    if np.abs(slope).sum() > EVEN or np.linalg.det(matrix) <= 0 or (np.diag(matrix) <= 0).any():
        return "is lit too unevenly"
    return ColourMatrix(matrix, "gains" if diagonal else "matrix", error, int(found.usable.sum()))


def _solved(found: Patches, used: Bool, diagonal: bool) -> tuple[F64, F64]:
    """M (3, 3) and (a, b)."""
    c, r, at = found.colours[used], REFLECTANCES[used], places()[used]
    weight = _weights()[used]
    count = 3 if diagonal else 9
    rows = np.zeros((len(c), 3, count + 2))
    for k in range(3):
        if diagonal:
            rows[:, k, k] = c[:, k]
        else:
            rows[:, k, 3 * k : 3 * k + 3] = c
    rows[..., count:] = -r[:, :, None] * at[:, None]
    solved = np.linalg.lstsq(
        (rows * weight[:, None, None]).reshape(-1, count + 2), (r * weight[:, None]).ravel(), rcond=None
    )[0]
    matrix = np.diag(solved[:3]) if diagonal else solved[:9].reshape(3, 3)
    return np.asarray(matrix, np.float64), np.asarray(solved[count:], np.float64)


def _left_out(found: Patches, diagonal: bool) -> float:
    """Root mean square of the weighted errors of patches that their solution did not see."""
    weight, at = _weights(), places()
    errors = []
    for i in np.flatnonzero(found.usable):
        used = found.usable.copy()
        used[i] = False
        matrix, slope = _solved(found, used, diagonal)
        errors.append(weight[i] * (matrix @ found.colours[i] - REFLECTANCES[i] * (1 + at[i] @ slope)))
    return float(np.sqrt(np.mean(np.square(errors))))


def _weights() -> F64:
    return np.asarray(1 / (REFLECTANCES @ np.array(LUMA) + DARK), np.float64)
