"""Compiled solver of the deformation's linear system.

Symbols: x (V, 3) the cage; L (V, V) symmetric, of the terms that treat the three coordinates alike; S (M, V) the
stencils of the points that lie on a surface, n (M, 3) its normals there, w (M,) weights.

    (L + S^T W n n^T S) x = b        positive definite if L is; conjugate gradients, preconditioned by 3 x 3 blocks

Source: Hestenes and Stiefel (1952); Saad, Iterative methods for sparse linear systems, section 9.2.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.sparse import csr_array

from pipeline.meshes import F64

Rows = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], F64]  # indptr, indices, data of a sparse matrix


def rows_of(matrix: csr_array) -> Rows:
    """The arrays of a sparse matrix, as the kernels take them."""
    m = csr_array(matrix)
    return m.indptr.astype(np.int64), m.indices.astype(np.int64), m.data.astype(np.float64)


def solved(
    alike: csr_array,
    stencil: csr_array,
    normals: F64,
    weights: F64,
    right: F64,
    start: F64,
    tolerance: float,
    most: int,
) -> tuple[F64, int]:
    """x (V, 3) from start (V, 3), and the number of steps. tolerance: of the residual's length over that at the start;
    most: steps."""
    transposed = csr_array(stencil.T)
    blocks = _inverse_blocks(*rows_of(alike), *rows_of(transposed), normals, weights)
    x, steps = _conjugate_gradients(
        *rows_of(alike),
        *rows_of(stencil),
        *rows_of(transposed),
        normals,
        weights,
        blocks,
        right,
        start,
        tolerance,
        most,
    )
    return np.asarray(x), int(steps)


@njit(error_model="numpy", cache=True)
def _inverse_blocks(  # type: ignore[no-untyped-def]
    l_start, l_column, l_value, t_start, t_column, t_value, normals, weights
):
    """(V, 3, 3) inverses of the diagonal's blocks. t_*: the stencils' transposed matrix."""
    count = len(l_start) - 1
    out = np.empty((count, 3, 3))
    for i in range(count):
        block = np.zeros((3, 3))
        for k in range(l_start[i], l_start[i + 1]):
            if l_column[k] == i:
                for c in range(3):
                    block[c, c] += l_value[k]
        for k in range(t_start[i], t_start[i + 1]):
            m = t_column[k]
            factor = weights[m] * t_value[k] * t_value[k]
            for a in range(3):
                for b in range(3):
                    block[a, b] += factor * normals[m, a] * normals[m, b]
        out[i] = np.linalg.inv(block)
    return out


@njit(error_model="numpy", cache=True)
def _row_times(start, column, value, i, x):  # type: ignore[no-untyped-def]
    """Row i of a sparse matrix times x (V, 3)."""
    a = b = c = 0.0
    for k in range(start[i], start[i + 1]):
        j, v = column[k], value[k]
        a += v * x[j, 0]
        b += v * x[j, 1]
        c += v * x[j, 2]
    return a, b, c


@njit(error_model="numpy", cache=True)
def _applied(  # type: ignore[no-untyped-def]
    l_start, l_column, l_value, s_start, s_column, s_value, t_start, t_column, t_value, normals, weights, x, out
):
    """out (V, 3) = the matrix times x (V, 3)."""
    for i in range(len(out)):
        out[i, 0], out[i, 1], out[i, 2] = _row_times(l_start, l_column, l_value, i, x)
    along = np.empty(len(normals))
    for m in range(len(normals)):
        a, b, c = _row_times(s_start, s_column, s_value, m, x)
        along[m] = weights[m] * (a * normals[m, 0] + b * normals[m, 1] + c * normals[m, 2])
    for i in range(len(out)):
        for k in range(t_start[i], t_start[i + 1]):
            m = t_column[k]
            v = t_value[k] * along[m]
            out[i, 0] += v * normals[m, 0]
            out[i, 1] += v * normals[m, 1]
            out[i, 2] += v * normals[m, 2]


@njit(error_model="numpy", cache=True)
def _conjugate_gradients(  # type: ignore[no-untyped-def]
    l_start, l_column, l_value, s_start, s_column, s_value, t_start, t_column, t_value,
    normals, weights, blocks, right, start, tolerance, most,
):  # fmt: skip
    count = len(right)
    x, product = start.copy(), np.empty((count, 3))
    _applied(
        l_start, l_column, l_value, s_start, s_column, s_value, t_start, t_column, t_value, normals, weights, x, product
    )
    residual = right - product
    z, direction = np.empty((count, 3)), np.zeros((count, 3))
    size, before, steps = tolerance * np.sqrt((residual * residual).sum()), 1.0, 0
    while steps < most and np.sqrt((residual * residual).sum()) > size and before > 0:
        now = 0.0
        for i in range(count):
            for a in range(3):
                z[i, a] = (
                    blocks[i, a, 0] * residual[i, 0]
                    + blocks[i, a, 1] * residual[i, 1]
                    + blocks[i, a, 2] * residual[i, 2]
                )
                now += z[i, a] * residual[i, a]
        ratio = now / before if steps else 0.0
        direction = z + ratio * direction
        _applied(
            l_start, l_column, l_value, s_start, s_column, s_value, t_start, t_column, t_value,
            normals, weights, direction, product,
        )  # fmt: skip
        length = now / (direction * product).sum()
        x += length * direction
        residual -= length * product
        before = now
        steps += 1
    return x, steps
