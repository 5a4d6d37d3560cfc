"""Values of texels that vary slowly over the skin, as means over the texels around: gloss, and light by way of skin.

A texel alone sees a highlight in few pictures, and its weights of lobes are noise to a large part. Over some
millimetres skin has one gloss, but for lips, brows and other tissue, which have other albedos. So the mean is

    s_i = sum_j w_ij s_j / sum_j w_ij
    w_ij = e_j (n_i . n_j)^2 exp(-|x_i - x_j|^2 / (2 W^2) - |log a_i - log a_j|^2 / (6 A^2))

Symbols
    x, n, a    position, unit normal and albedo of a texel; j runs over texels that a camera sees, normals to one side
    e          evidence: squared cosines towards the cameras that see the texel, summed
    W, A       WIDTH and ALBEDO
Texels are gathered in cells of CELL first, so that the time hardly grows with their number.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_array, vstack
from scipy.spatial import cKDTree

from pipeline.images import F32
from pipeline.meshes import F64, unit
from stages.reflectance.texels import Pairs, Points

WIDTH, ALBEDO = 0.004, 0.2  # metres; of the natural logarithm
CELL = 0.0015  # metres: edge of the cells
AROUND = 64  # cells whose mean is taken
DARKEST = 0.02  # albedos below are taken as this before the logarithm
BLOCK = 65_536  # texels at a time


class Pooled:
    """The mean over the texels around each of T texels. albedo (T, 3)."""

    def __init__(self, points: Points, pairs: Pairs, albedo: F64) -> None:
        evidence = np.bincount(pairs.texel, pairs.weight, len(points.texel))
        seen = np.flatnonzero(evidence > 0)
        self.evidence = evidence
        self.cell_of, count = _cells(points.position[seen], points.normal[seen])
        self.seen = seen
        total = self._gathered(np.ones((len(points.texel), 1)), count)[:, 0]
        self.count, self.total = count, total
        log = np.log(np.maximum(albedo, DARKEST))
        both = np.concatenate([points.position, points.normal, log], 1)
        cells = self._gathered(both, count) / np.maximum(total, 1e-30)[:, None]
        self.matrix = _weights(points.position, points.normal, log, cells, total) if count else None

    def __call__(self, values: F32) -> F32:
        """(T, ...) means of values (T, ...); the value itself where nothing is near."""
        flat = values.reshape(len(values), -1).astype(np.float64)
        if self.matrix is None:
            return values
        cells = self._gathered(flat, self.count) / np.maximum(self.total, 1e-30)[:, None]
        share = np.asarray(self.matrix.sum(axis=1), np.float64).reshape(-1, 1)
        found = np.where(share > 1e-9, self.matrix @ cells / np.maximum(share, 1e-30), flat)
        return np.asarray(found.reshape(values.shape), np.float32)

    def _gathered(self, values: F64, count: int) -> F64:
        """(count, n) sums of values (T, n) in the cells, weighted by the evidence."""
        some = values[self.seen] * self.evidence[self.seen, None]
        return np.stack([np.bincount(self.cell_of, some[:, i], count) for i in range(values.shape[1])], 1)


def _cells(position: F64, normal: F64) -> tuple[Any, int]:
    """(N,) cell of each point, and their number: cubes of CELL, two of them where surfaces face apart."""
    place = np.floor(position / CELL).astype(np.int64)
    axis = np.abs(normal).argmax(1)
    side = 2 * axis + (normal[np.arange(len(normal)), axis] > 0)
    _, cell = np.unique(np.concatenate([place, side[:, None]], 1), axis=0, return_inverse=True)
    cell = cell.ravel()
    return cell, int(cell.max()) + 1 if len(cell) else 0


def _weights(position: F64, normal: F64, log: F64, cells: F64, total: F64) -> Any:
    """Sparse (T, cells) weights."""
    tree, count, around = cKDTree(cells[:, :3]), len(position), min(AROUND, len(cells))
    facing = unit(cells[:, 3:6])
    parts = []
    for first in range(0, count, BLOCK):
        some = slice(first, min(first + BLOCK, count))
        far, near = tree.query(position[some], k=around, distance_upper_bound=3 * WIDTH)
        far, near = far.reshape(-1, around), near.reshape(-1, around)
        there = np.isfinite(far)
        near = np.where(there, near, 0)
        alike = ((log[some, None] - cells[near, 6:]) ** 2).sum(2) / (6 * ALBEDO**2)
        turned = (normal[some, None] * facing[near]).sum(2).clip(min=0) ** 2
        weight = np.where(there, np.exp(-(np.where(there, far, 0) ** 2) / (2 * WIDTH**2) - alike), 0.0)
        weight = (weight * turned * total[near]).astype(np.float32)
        row = np.repeat(np.arange(some.stop - some.start), around)
        parts.append(csr_array((weight.ravel(), (row, near.ravel())), shape=(some.stop - some.start, len(cells))))
    return parts[0] if len(parts) == 1 else vstack(parts, format="csr")
