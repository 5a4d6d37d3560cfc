"""The material of standard shaders (OpenPBR) from the single lights: base colour, F0 and roughness.

    e_k = sum over texels around   w(texel) error_k      for each width alpha_k
    k*  = least of e_k, between the widths by a parabola;   base and F0 are those of the widths on either side, mixed
    b   = b' / (1 - R)

Symbols
    error_k, b'   of the fit with one layer of that width (layer_kernels.py)
    R             share that the layer keeps from the base, at the texel's mean n.v (pipeline/lighting/standard.py)
Roughness varies slowly, and one texel's samples hardly tell it: errors are pooled over cells of CELL.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.images import F32
from pipeline.transforms import F64

WIDTHS = np.geomspace(0.03, 0.42, 8)  # GGX alphas that are tried
CELL, AROUND = 0.003, 8  # asset units (metres): cells over which errors are pooled, and how many a texel takes
USUAL, PULL = 0.18, 2e-8  # alpha towards which texels without evidence go, and the weight of that (y squared)
LARGEST = 0.98  # of a base colour
LEAST_F0, MOST_F0 = 0.005, 0.3


@dataclass(frozen=True, slots=True)
class Layers:
    """Fits of T texels with one layer of each of K widths: base (T, K, 3); f0, error (T, K); facing (T,) mean n.v."""

    base: F32
    f0: F32
    error: F32
    facing: F32

    @staticmethod
    def empty(count: int) -> Layers:
        """Nothing fitted."""
        k = len(WIDTHS)
        return Layers(np.zeros((count, k, 3), np.float32), np.zeros((count, k), np.float32),
                      np.zeros((count, k), np.float32), np.zeros(count, np.float32))  # fmt: skip


def standard_of(layers: Layers, position: F64) -> F32:
    """(T, 5) base colour, F0 and roughness of texels at position (T, 3); 0 where nothing was fitted."""
    from pipeline.lighting.standard import layer

    known = np.flatnonzero(layers.facing > 0)
    out = np.zeros((len(position), 5), np.float32)
    if not len(known):
        return out
    pooled = pooled_errors(layers.error[known].astype(np.float64), position[known])
    at = lowest(pooled + PULL * np.log(WIDTHS / USUAL) ** 2)
    low = np.minimum(at.astype(np.int64), len(WIDTHS) - 2)
    share = at - low

    def between(values: npt.NDArray[np.floating]) -> F64:
        part = share.reshape(-1, *[1] * (values.ndim - 2))
        return np.asarray(values[known, low] * (1 - part) + values[known, low + 1] * part, np.float64)

    f0 = between(layers.f0).clip(LEAST_F0, MOST_F0)
    alpha = WIDTHS[0] * (WIDTHS[1] / WIDTHS[0]) ** at
    kept = 1 - layer(layers.facing[known].astype(np.float64), f0, alpha)
    out[known, :3] = (between(layers.base) / kept[:, None]).clip(0, LARGEST)
    out[known, 3], out[known, 4] = f0, np.sqrt(alpha)
    return out


def pooled_errors(error: F64, position: F64) -> F64:
    """(N, K) errors of texels at position (N, 3), each the mean over the cells around it, nearer ones more."""
    from scipy.spatial import cKDTree

    cell = np.floor(position / CELL).astype(np.int64)
    _, number = np.unique(cell, axis=0, return_inverse=True)
    number = number.ravel()
    size = np.bincount(number).astype(np.float64)
    centre = np.stack([np.bincount(number, position[:, i]) for i in range(3)], 1) / size[:, None]
    total = np.stack([np.bincount(number, error[:, k]) for k in range(error.shape[1])], 1)
    many = min(AROUND, len(size))
    far, near = cKDTree(centre).query(position, many)
    far, near = np.reshape(far, (-1, many)), np.reshape(near, (-1, many))
    weight = np.exp(-((far / CELL) ** 2) / 2)
    below = (weight * size[near]).sum(1)
    return np.asarray(np.einsum("nj,njk->nk", weight, total[near]) / np.maximum(below, 1e-12)[:, None], np.float64)


def lowest(cost: F64) -> F64:
    """(N,) places of the least costs (N, K) on 0 ... K - 1, between them by a parabola."""
    every, best = np.arange(len(cost)), cost.argmin(1)
    inner = np.clip(best, 1, cost.shape[1] - 2)
    before, least, after = cost[every, inner - 1], cost[every, inner], cost[every, inner + 1]
    bend = before - 2 * least + after
    shift = np.where(bend > 0, (before - after) / np.maximum(2 * bend, 1e-30), 0.0).clip(-0.5, 0.5)
    return np.asarray(np.where(best == inner, inner + shift, best), np.float64)
