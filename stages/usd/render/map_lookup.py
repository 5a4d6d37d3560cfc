"""Values of maps and tables between their samples."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stages.usd.render import kernels

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


def bilinear(image: F32, uv: npt.NDArray[np.floating], tiles: int = 1) -> F32:
    """(N, C) values of (H, W, C) at uv (N, 2): texel centres at +0.5, v up, clamped at the border. `tiles`: the image
    consists of that many squares side by side, tile t for t <= u < t + 1, each clamped at its own border."""
    out = np.empty((len(uv), image.shape[2]), np.float32)
    kernels.bilinear(np.ascontiguousarray(image, np.float32), tiles, uv, out)
    return out


def lookup(table: F32, cosine: F64) -> F32:
    """(N, k) rows of the (W, k) table for cosines (N,). Row i is n.v = (i + 0.5) / W; linear between rows, constant
    beyond the ends."""
    width = len(table)
    x = (cosine * width - 0.5).clip(0, width - 1)
    low = np.floor(x).astype(np.int64)
    f = (x - low)[:, None].astype(np.float32)
    return np.asarray(table[low] * (1 - f) + table[np.minimum(low + 1, width - 1)] * f, np.float32)
