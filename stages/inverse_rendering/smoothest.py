"""The smoothest function on a part of a grid that stays near given values: a sparse linear least-squares problem.

Symbols: f values at the N nodes of the part; t, w >= 0 target and weight there; L the Laplacian of the grid, in cells,
with the given values around the part as its border. Minimised:

    sum w (f - t)^2 + |L f|^2

A ripple of wavelength 2 pi q cells keeps w q^4 / (1 + w q^4) of its height: w = q^-4 halves it.
Source: Calakli and Taubin, SSD: smooth signed distance surface reconstruction (2011).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stages.inverse_rendering import smoothest_kernels as kernels

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
ITERATIONS, TOLERANCE = 80, 1e-4  # of conjugate gradients


@dataclass(frozen=True, slots=True)
class Laplacian:
    """L for N nodes. near (N, 6): the numbers of a node's neighbours, -1 where one is not solved for; degree (N,): how
    many it has: nodes at the grid's faces have only those that exist; border (N,): the part of L f that neighbours that
    are not solved for contribute."""

    near: npt.NDArray[np.int32]
    degree: F64
    border: F64

    def __call__(self, f: F64) -> F64:
        """(N,) L f, without the border's part."""
        out = np.empty_like(f)
        kernels.laplace(self.near, self.degree, f, out)
        return out

    def squared_diagonal(self) -> F64:
        """(N,) diagonal of L^T L."""
        return np.asarray(self.degree**2 + (self.near >= 0).sum(1))


def laplacian(inside: Bool, around: F64) -> Laplacian:
    """L for the nodes of `inside` (X, Y, Z); around (X, Y, Z): values of the other nodes."""
    flat = np.flatnonzero(inside)
    number = np.full(inside.size, -1, np.int32)
    number[flat] = np.arange(len(flat))
    near, degree, border = np.empty((len(flat), 6), np.int32), np.empty(len(flat)), np.empty(len(flat))
    values = np.ascontiguousarray(around, np.float64).reshape(-1)
    kernels.neighbours(flat, number, values, inside.shape, near, degree, border)
    return Laplacian(near, degree, border)


def smoothest(inside: Bool, around: F64, weight: F64, target: F64, first: F64, iterations: int = ITERATIONS) -> F64:
    """(N,) the minimum, by conjugate gradients from first (N,). inside (X, Y, Z): the part; around (X, Y, Z): values
    of the other nodes; weight, target (N,), in the order of inside's nodes."""
    return solved(laplacian(inside, around), weight, target, first, iterations)


def solved(operator: Laplacian, weight: F64, target: F64, first: F64, iterations: int = ITERATIONS) -> F64:
    """The same for a Laplacian that is known."""
    weight, found = np.ascontiguousarray(weight, np.float64), np.array(first, np.float64)
    right = weight * target - operator(operator.border)
    diagonal = weight + operator.squared_diagonal()
    kernels.conjugate_gradients(operator.near, operator.degree, weight, diagonal, right, found, TOLERANCE, iterations)
    return found
