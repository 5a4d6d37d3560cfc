"""The linear colour correction from a photo's colours to the reflectances of the chart in it.

Symbols: c_i linear colour of patch i in the photo, r_i its reflectance, (x_i, y_i) its place on the chart; M (3, 3), or
a diagonal of three gains. Uneven light on the chart is modelled as a factor 1 + a x + b y of its patches; then

    M c_i = r_i (1 + a x_i + b y_i)

is linear in M, a and b, and is solved with weights 1 / (Y_i + 0.1), Y_i the patch's luminance: relative errors count,
absolute ones for dark patches. The error is a leave-one-out error: each patch is predicted without itself.

The correction fixes the white balance and the unit: M c = 1 is a perfect white at the chart's place. It can't fix the
scale of the albedo, because the irradiance of the head and that of the chart differ.

Differs: in the paper each capture has one camera response, and only the losses define its white.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.colour import LUMA
from stages.capture.colour_checker import F64, PATCHES, REFLECTANCES, Bool, Patches, places

DARK = 0.1
FEWEST = 14  # patches: fewer do not separate the correction from noise
WRONG = 0.15  # largest weighted error of a usable chart: permuted patches have errors of 0.2 to 1.2
SIMPLER = 0.8  # the 3 x 3 matrix is used if its error is at most this share of that of the gains
EVEN = 0.8  # largest |a| + |b|: beyond it the light on the chart changes too much


@dataclass(frozen=True, slots=True)
class ColourMatrix:
    """matrix: (3, 3), reflectance from the photo's linear colours. way: its form. error: weighted RMS, leave-one-out.
    patches: number of patches used."""

    matrix: F64
    way: Literal["gains", "matrix"]
    error: float
    patches: int


def colour_matrix_of(found: Patches) -> ColourMatrix | str:
    """M of a chart; or why it can't be used, as the end of a sentence that begins 'the colour checker'."""
    if found.usable.sum() < FEWEST:
        return f"has {int(found.usable.sum())} patches of {PATCHES} that are large enough and not clipped"
    three, nine = (_left_out(found, diagonal) for diagonal in (True, False))
    diagonal = nine > SIMPLER * three
    error = three if diagonal else nine
    if error > WRONG:
        return f"does not have the colours of a classic checker of 24 patches (error {error:.0%})"
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
    """RMS of the weighted leave-one-out errors."""
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
