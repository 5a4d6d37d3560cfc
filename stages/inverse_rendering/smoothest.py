"""The smoothest function on a part of a grid that stays near given values: a sparse linear least-squares problem.

Symbols: f values at the N nodes of the part; t, w >= 0 target and weight there; L the Laplacian of the grid, in cells,
with the given values around the part as its border. Minimised:

    sum w (f - t)^2 + |L f|^2

A ripple of wavelength 2 pi q cells keeps w q^4 / (1 + w q^4) of its height: w = q^-4 halves it.
Source: Calakli and Taubin, SSD: smooth signed distance surface reconstruction (2011).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
ITERATIONS, TOLERANCE = 80, 1e-4  # of conjugate gradients


def smoothest(inside: Bool, around: F64, weight: F64, target: F64, first: F64, iterations: int = ITERATIONS) -> F64:
    """(N,) the minimum, by conjugate gradients from first (N,). inside (X, Y, Z): the part; around (X, Y, Z): values
    of the other nodes; weight, target (N,), in the order of inside's nodes."""
    operator, border = laplacian(inside, around)
    diagonal = weight + np.asarray(operator.multiply(operator).sum(0)).ravel()
    n = len(weight)
    product = LinearOperator((n, n), lambda f: weight * f + operator.T @ (operator @ f), dtype=np.float64)
    jacobi = LinearOperator((n, n), lambda f: f / diagonal, dtype=np.float64)
    right = weight * target - operator.T @ border
    found, _ = cg(product, right, first, rtol=TOLERANCE, maxiter=iterations, M=jacobi)
    return np.asarray(found, np.float64)


def laplacian(inside: Bool, around: F64) -> tuple[sparse.csr_matrix, F64]:
    """L (N, N) for the nodes of `inside`, and (N,) the part of L f that their neighbours outside contribute. Nodes at
    the grid's faces have only the neighbours that exist."""
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(int(inside.sum()))
    node = np.argwhere(inside)
    own, n = number[inside], len(node)
    border, degree = np.zeros(n), np.zeros(n)
    rows, columns = [], []
    for axis in range(3):
        for step in (-1, 1):
            at = node.copy()
            at[:, axis] += step
            exists = (at[:, axis] >= 0) & (at[:, axis] < inside.shape[axis])
            there = tuple(at[exists].T)
            degree[exists] += 1
            other = number[there]
            border[exists] += np.where(other < 0, around[there], 0)
            rows.append(own[exists][other >= 0])
            columns.append(other[other >= 0])
    row, column = np.concatenate([*rows, own]), np.concatenate([*columns, own])
    value = np.concatenate([np.ones(len(row) - n), -degree])
    return sparse.csr_matrix((value, (row, column)), (n, n)), border
