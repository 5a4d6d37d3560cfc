"""Values of maps and tables between their samples."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit, prange

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


def bilinear(image: F32, uv: npt.NDArray[np.floating], tiles: int = 1) -> F32:
    """(N, C) values of (H, W, C) at uv (N, 2): texel centres at +0.5, v up, clamped at the border. `tiles`: the image
    consists of that many squares side by side, tile t for t <= u < t + 1, each clamped at its own border."""
    out = np.empty((len(uv), image.shape[2]), np.float32)
    _bilinear(np.ascontiguousarray(image, np.float32), tiles, uv, out)
    return out


@njit(parallel=True, error_model="numpy", cache=True)
def _bilinear(image: F32, tiles: int, uv: npt.NDArray[np.floating], out: F32) -> None:
    """(N, C) values of (H, W, C), `tiles` squares side by side, at uv (N, 2): texel centres at +0.5, v up, clamped at
    the border of each tile."""
    h, w, channels = image.shape[0], image.shape[1] // tiles, image.shape[2]
    for i in prange(len(uv)):
        tile = min(max(int(uv[i, 0]), 0), tiles - 1)
        x = min(max((uv[i, 0] - tile) * w - 0.5, 0.0), w - 1.0)
        y = min(max((1.0 - uv[i, 1]) * h - 0.5, 0.0), h - 1.0)
        x0, y0 = int(x), int(y)
        x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
        fx, fy = np.float32(x - x0), np.float32(y - y0)
        x0, x1 = x0 + tile * w, x1 + tile * w
        for k in range(channels):
            top = image[y0, x0, k] * (1 - fx) + image[y0, x1, k] * fx
            low = image[y1, x0, k] * (1 - fx) + image[y1, x1, k] * fx
            out[i, k] = top * (1 - fy) + low * fy


def lookup(table: F32, cosine: F64) -> F32:
    """(N, k) rows of the (W, k) table for cosines (N,). Row i is n.v = (i + 0.5) / W; linear between rows, constant
    beyond the ends."""
    width = len(table)
    x = (cosine * width - 0.5).clip(0, width - 1)
    low = np.floor(x).astype(np.int64)
    f = (x - low)[:, None].astype(np.float32)
    return np.asarray(table[low] * (1 - f) + table[np.minimum(low + 1, width - 1)] * f, np.float32)
