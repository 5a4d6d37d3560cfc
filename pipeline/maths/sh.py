"""Real spherical harmonics, and the convolution of a lobe with them.

Symbols: Y_lm real, orthonormal over the sphere, without the Condon-Shortley phase: Y_1 = sqrt(3 / 4 pi) (y, z, x).
Index l (l + 1) + m. Directions d are (N, 3) unit vectors. Coefficients c are ((L + 1)^2, 3), one column a colour.
Everything is a polynomial in x, y, z (no angles), so that values and derivatives are finite at the poles.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline.maths import cuda_kernels
from pipeline.maths.precision import full_precision
from pipeline.maths.sh_recurrence import recurrence

try:
    from pipeline.maths import sh_compiled as compiled
except ImportError:  # a minimal GPU machine only has torch
    compiled = None  # type: ignore[assignment]

ORDER = 10  # [NeuFace eq. 2]


def count(order: int) -> int:
    """Number of coefficients up to and including `order`."""
    return (order + 1) ** 2


def order_of(coefficients: Tensor) -> int:
    """Order L of ((L + 1)^2, ...) coefficients; ValueError if the length is not a square."""
    order = math.isqrt(coefficients.shape[0]) - 1
    if count(order) != coefficients.shape[0]:
        raise ValueError(f"{coefficients.shape[0]} SH coefficients; expected a square number (L + 1)^2")
    return order


@full_precision
def sh_basis(d: Tensor, order: int = ORDER) -> Tensor:
    """All Y_lm up to `order`: (N, 3) -> (N, (order + 1)^2).

        Y_lm = K_lm P_l^|m|(z) / sin^|m| * (Im or Re) (x + i y)^|m|

    The normalised ratio Q_l^m = K_lm P_l^m / sin^m obeys the three-term recurrence in l
    (Q_l^m = a z Q_{l-1}^m - b Q_{l-2}^m), run for all m at once. float32 error below 3e-6 at order 10.
    """
    if cuda_kernels.usable(d):
        found: Tensor = cuda_kernels.ShBasis.apply(d, order)  # type: ignore[no-untyped-call]
        return found
    x, y, z = d.unbind(-1)
    q = _associated(z, order)
    re, im = _powers(x, y, order)
    columns = []
    for l in range(order + 1):  # noqa: E741
        ql = q[l]  # (l + 1, N)
        if l:
            columns.append((ql[1:] * im[1 : l + 1]).flip(0))
        columns.append(ql[:1])
        if l:
            columns.append(ql[1:] * re[1 : l + 1])
    return torch.cat(columns).T


def _powers(x: Tensor, y: Tensor, order: int) -> tuple[Tensor, Tensor]:
    """Re and Im of (x + i y)^m, times sqrt(2) for m > 0: (order + 1, N) each."""
    re, im = [torch.ones_like(x), math.sqrt(2) * x], [torch.zeros_like(x), math.sqrt(2) * y]
    for _ in range(2, order + 1):
        re, im = [*re, x * re[-1] - y * im[-1]], [*im, x * im[-1] + y * re[-1]]
    return torch.stack(re[: order + 1]), torch.stack(im[: order + 1])


def _associated(z: Tensor, order: int) -> list[Tensor]:
    """Q_l^m for l = 0..order, each (l + 1, N)."""
    start, a, b = recurrence(order)
    one = torch.ones_like(z)
    out = [start[0] * one[None]]
    for l in range(1, order + 1):  # noqa: E741
        rows = [a[l].to(z)[:l, None] * z * out[l - 1]]
        if l >= 2:
            rows[0] = torch.cat([rows[0][: l - 1] - b[l].to(z)[: l - 1, None] * out[l - 2], rows[0][l - 1 :]])
        rows.append(start[l] * one[None])
        out.append(torch.cat(rows))
    return out


@lru_cache(maxsize=32)
def clamped_cosine(order: int = ORDER) -> Tensor:
    """Lambda_l of the half-cosine lobe, one per coefficient: ((order + 1)^2,) float64. [NeuFace eq. 15]

    Differs: the equation has a separate case for l = 1 and gives 0 for other odd l; here it is written per l.
    """
    values: list[float] = []
    for l in range(order + 1):  # noqa: E741
        if l == 1:
            v = 2 * math.pi / 3
        elif l % 2:
            v = 0.0
        else:
            v = (-1) ** (l // 2 + 1) * math.pi / (2.0 ** (l - 1) * (l - 1) * (l + 2)) * math.comb(l, l // 2)
        values += [v] * (2 * l + 1)
    return torch.tensor(values, dtype=torch.float64)


@full_precision
def irradiance(c: Tensor, n: Tensor) -> Tensor:
    """E(n) = sum_lm Lambda_l c_lm Y_lm(n): (N, 3). The sum in [NeuFace eq. 16], by [NeuFace eq. 14]; may be
    slightly negative."""
    return band_radiance(clamped_cosine(order_of(c)).to(c)[:, None] * c, n).sum(1)


@full_precision
def radiance(c: Tensor, d: Tensor) -> Tensor:
    """L(d) = sum_lm c_lm Y_lm(d): (N, 3). [NeuFace eq. 2]"""
    return sh_basis(d, order_of(c)) @ c


def rotated(c: npt.NDArray[np.float64], axes: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Coefficients ((L + 1)^2, K) of L'(d) = L(R^T d), a light c ((L + 1)^2, K) whose frame has the columns of R (3, 3)
    as its axes. Exact up to rounding (1e-12), because rotations do not mix bands: least squares over more directions
    than coefficients."""
    order = order_of(torch.from_numpy(c))
    d = spiral(2 * len(c) + 8)
    now, then = (sh_basis(torch.from_numpy(np.ascontiguousarray(x)), order).numpy() for x in (d, d @ axes))
    return np.asarray(np.linalg.lstsq(now, then @ c, rcond=None)[0], np.float64)


def spiral(number: int) -> npt.NDArray[np.float64]:
    """(number, 3) directions that are spread evenly over the sphere."""
    z = 1 - (2 * np.arange(number) + 1) / number
    turn = np.pi * (1 + 5**0.5) * np.arange(number)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


@full_precision
def band_radiance(c: Tensor, d: Tensor) -> Tensor:
    """Contribution of each band to L(d): (N, L + 1, 3). Compiled for float32 on the CPU if numba is installed, else one
    matrix product for all bands."""
    order = order_of(c)
    if compiled is not None and d.dtype == c.dtype == torch.float32 and d.device.type == "cpu":
        out: Tensor = compiled.BandRadiance.apply(c, d, order)  # type: ignore[no-untyped-call]
        return out
    return band_radiance_reference(c, d, order)


@full_precision
def band_radiance_reference(c: Tensor, d: Tensor, order: int) -> Tensor:
    """`band_radiance` in plain torch."""
    spread = (c[:, None, :] * band_selector(order).to(c)[:, :, None]).reshape(c.shape[0], -1)
    return (sh_basis(d, order) @ spread).reshape(d.shape[0], order + 1, 3)


@lru_cache(maxsize=32)
def band_selector(order: int) -> Tensor:
    """((order + 1)^2, order + 1) of 0 and 1: which band a coefficient belongs to."""
    out = torch.zeros(count(order), order + 1)
    for l in range(order + 1):  # noqa: E741
        out[l * l : (l + 1) ** 2, l] = 1
    return out
