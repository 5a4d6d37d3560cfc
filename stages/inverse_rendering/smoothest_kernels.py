"""Compiled loops of smoothest.py: the grid's Laplacian, and conjugate gradients with it.

Symbols as there; N nodes; `near` (N, 6) the numbers of a node's neighbours, -1 where one is not solved for; `degree`
(N,) how many neighbours it has, solved for or not. The Laplacian is symmetric, so that L^T L f is L applied twice.
Sums over all nodes are sums of blocks of one size, so that they do not depend on the number of threads.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

BLOCK = 16_384  # nodes


@njit(parallel=True, error_model="numpy", cache=True)
def neighbours(flat, number, around, shape, near, degree, border):
    """Fill near, degree, and border (N,): the part of L f that neighbours outside contribute. flat (N,): the nodes in
    the flattened grid; number, around: flattened, the nodes' numbers (-1 elsewhere) and the values."""
    strides = (shape[1] * shape[2], shape[2], 1)
    for n in prange(len(flat)):
        i = flat[n]
        at = (i // strides[0], (i // strides[1]) % shape[1], i % shape[2])
        total, count = 0.0, 0
        for axis in range(3):
            for side in range(2):
                near[n, 2 * axis + side] = -1
                if (at[axis] == 0) if side == 0 else (at[axis] == shape[axis] - 1):
                    continue
                there = i - strides[axis] if side == 0 else i + strides[axis]
                count += 1
                near[n, 2 * axis + side] = number[there]
                if number[there] < 0:
                    total += around[there]
        degree[n], border[n] = count, total


@njit(parallel=True, error_model="numpy", cache=True)
def laplace(near, degree, f, out):
    """out = L f, (N,)."""
    for n in prange(len(f)):
        total = -degree[n] * f[n]
        for k in range(6):
            if near[n, k] >= 0:
                total += f[near[n, k]]
        out[n] = total


@njit(error_model="numpy", cache=True)
def _total(parts):
    """Their sum, in one order: numba splits `parts.sum()` of a parallel function among its threads."""
    total = 0.0
    for k in range(len(parts)):
        total += parts[k]
    return total


@njit(parallel=True, error_model="numpy", cache=True)
def dot(a, b):
    """a . b, (N,) each."""
    blocks = (len(a) + BLOCK - 1) // BLOCK
    parts = np.zeros(blocks)
    for k in prange(blocks):
        total = 0.0
        for n in range(k * BLOCK, min((k + 1) * BLOCK, len(a))):
            total += a[n] * b[n]
        parts[k] = total
    return _total(parts)


@njit(parallel=True, error_model="numpy", cache=True)
def _product(near, degree, weight, f, once, out):
    """out = (W + L^T L) f, and f . out. once (N,): room."""
    laplace(near, degree, f, once)
    laplace(near, degree, once, out)
    blocks = (len(f) + BLOCK - 1) // BLOCK
    parts = np.zeros(blocks)
    for k in prange(blocks):
        total = 0.0
        for n in range(k * BLOCK, min((k + 1) * BLOCK, len(f))):
            out[n] += weight[n] * f[n]
            total += f[n] * out[n]
        parts[k] = total
    return _total(parts)


@njit(parallel=True, error_model="numpy", cache=True)
def _advanced(x, residual, direction, image, diagonal, step):
    """Move x and the residual by a step; returns |residual|^2 and residual . residual / diagonal."""
    blocks = (len(x) + BLOCK - 1) // BLOCK
    parts = np.zeros((blocks, 2))
    for k in prange(blocks):
        square, scaled = 0.0, 0.0
        for n in range(k * BLOCK, min((k + 1) * BLOCK, len(x))):
            x[n] += step * direction[n]
            r = residual[n] - step * image[n]
            residual[n] = r
            square += r * r
            scaled += r * r / diagonal[n]
        parts[k, 0], parts[k, 1] = square, scaled
    return _total(parts[:, 0]), _total(parts[:, 1])


@njit(parallel=True, error_model="numpy", cache=True)
def _turned(direction, residual, diagonal, share):
    """The next direction: the residual over the diagonal, and a share of the last one."""
    for n in prange(len(direction)):
        direction[n] = residual[n] / diagonal[n] + share * direction[n]


@njit(error_model="numpy", cache=True)
def conjugate_gradients(near, degree, weight, diagonal, right, x, tolerance, iterations):
    """Solve (W + L^T L) x = right in place, from x, until |residual| <= tolerance |right|; returns the iterations.

    diagonal (N,): the preconditioner. Source: Saad, Iterative methods for sparse linear systems (2003), algorithm 9.1.
    """
    once, image, direction = np.empty_like(x), np.empty_like(x), np.zeros_like(x)
    _product(near, degree, weight, x, once, image)
    residual = right - image
    limit = tolerance * tolerance * dot(right, right)
    square, scaled = _advanced(x, residual, direction, image, diagonal, 0.0)
    share = 0.0
    for done in range(iterations):
        if square <= limit:
            return done
        _turned(direction, residual, diagonal, share)
        steepness = _product(near, degree, weight, direction, once, image)
        if not steepness > 0:
            return done
        before = scaled
        square, scaled = _advanced(x, residual, direction, image, diagonal, before / steepness)
        share = scaled / before
    return iterations
