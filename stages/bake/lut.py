"""The learned basis as a lookup table over n.v, for shaders.

Symbols: B_j(wo, n) basis of [NeuFace eq. 9]. The table holds its mean over directions at a fixed cosine c:

    lut_j(c) = mean over n uniform on the sphere, wo uniform on the cone n.wo = c, of B_j(wo, n)

The residual measures how much the basis depends on more than n.v: standard deviation over directions, over the mean.
"""

from __future__ import annotations

import numpy as np

from pipeline.fields.protocol import Field
from pipeline.meshes import F32, F64

COLUMNS = 64
NORMALS = 256  # spread evenly on the sphere
TURNS = 8  # directions wo around each normal


def basis_lut(field: Field) -> tuple[F32, float]:
    """(1, COLUMNS, k) means at n.v = (i + 0.5) / COLUMNS, and the residual, averaged over bases and columns."""
    n = fibonacci_sphere(NORMALS)
    axis = np.eye(3)[np.abs(n).argmin(1)]
    across = np.cross(n, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(n, across)
    means, variances = [], []
    for i in range(COLUMNS):
        c = (i + 0.5) / COLUMNS
        turn = 2 * np.pi * (np.arange(TURNS) / TURNS + i * 0.618034)
        side = np.cos(turn)[:, None, None] * across + np.sin(turn)[:, None, None] * along
        wo = (c * n + np.sqrt(1 - c * c) * side).reshape(-1, 3)
        b = field.basis(wo.astype(np.float32), np.tile(n, (TURNS, 1)).astype(np.float32)).astype(np.float64)
        means.append(b.mean(0))
        variances.append(b.var(0))
    mean, variance = np.array(means), np.array(variances)
    residual = float(np.sqrt(variance.mean()) / max(float(mean.mean()), 1e-12))
    return mean[None].astype(np.float32), residual


def fibonacci_sphere(count: int) -> F64:
    """(count, 3) unit vectors, evenly spread."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), z, r * np.sin(turn)], 1)
