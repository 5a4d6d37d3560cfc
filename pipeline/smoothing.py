"""Smoothing and harmonic continuation on a mesh, by heat diffusion on its vertices.

Symbols: M vertex areas (m^2); K the cotangent Laplacian, with weights above zero, so that results stay weighted means.
All matrices are symmetric and positive definite: an ordering for such ones (minimum degree of A + A^T, pivots on the
diagonal) fills in less than the default of the solver.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array, diags_array

from pipeline.maths.sparse import factorised
from pipeline.meshes import F64, Mask, Mesh, vertex_areas

COTANGENTS = (1e-3, 1e3)
STIFF = 1e8  # 1/m^2: known vertices keep their values
FAR = 10.0  # metres: unknown vertices follow their neighbours only


def laplacian(mesh: Mesh) -> tuple[F64, Any]:
    """M (V,) and K (V, V), sparse: K u = 0 for constant u, positive semidefinite."""
    x, count = mesh.vertices.astype(np.float64)[mesh.faces], len(mesh.vertices)
    mass = np.maximum(vertex_areas(mesh.vertices, mesh.faces), 1e-14)
    rows, columns, values = [], [], []
    for i in range(3):
        a, b = x[:, (i + 1) % 3] - x[:, i], x[:, (i + 2) % 3] - x[:, i]
        cotangent = (a * b).sum(1) / np.maximum(np.linalg.norm(np.cross(a, b), axis=1), 1e-14)
        rows.append(mesh.faces[:, (i + 1) % 3])
        columns.append(mesh.faces[:, (i + 2) % 3])
        values.append(0.5 * cotangent.clip(*COTANGENTS))
    where = (np.concatenate(rows), np.concatenate(columns))
    half = coo_array((np.concatenate(values), where), shape=(count, count))
    off = (half + half.T).tocsc()
    return mass, diags_array(off.sum(0)) - off


class Smoother:
    """Smooths with a kernel of standard deviation `width` (m): (M + width^2 / 4 K)^-1 M, applied twice."""

    def __init__(self, mesh: Mesh, width: float) -> None:
        self._mass, k = laplacian(mesh)
        self._solve = factorised(diags_array(self._mass) + width**2 / 4 * k)

    def __call__(self, values: F64) -> F64:
        """(V, C) smoothed values (V, C)."""
        for _ in range(2):
            values = self._solve.solve(self._mass[:, None] * values)
        return values

    def mean(self, values: F64, weights: F64) -> F64:
        """(V, C) local mean of values (V, C) with weights (V,); about 0 far from all weights."""
        both = self(np.concatenate([values * weights[:, None], weights[:, None]], 1))
        return np.asarray(both[:, :-1] / np.maximum(both[:, -1:], 1e-9))


def continued(mesh: Mesh, values: F64, known: Mask, target: F64 | None = None, length: float = FAR) -> F64:
    """(V, C) values (V, C) at known vertices (V,), and their continuation at the others: harmonic (K u = 0), or drawn
    to target (V, C) over a length in metres, by the screened Poisson equation K u + M (u - target) / length^2 = 0.

    Components without a known vertex take the target, by default the mean of all known values.
    """
    if known.all() or not known.any():
        return values
    mass, k = laplacian(mesh)
    pull = mass * np.where(known, STIFF, length**-2)
    wanted = np.where(known[:, None], values, values[known].mean(0) if target is None else target)
    return np.asarray(factorised(k + diags_array(pull)).solve(pull[:, None] * wanted))
