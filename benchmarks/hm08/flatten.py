"""Lays quads flat: a start without flips, then as little stretch as possible, with some coordinates held.

Symbols
    J       2x2 Jacobian of a triangle's map from its rest shape in the plane; s1, s2 its singular values
    E       symmetric Dirichlet energy [Smith and Schaefer 2015]: area * (s1^2 + s2^2 + s1^-2 + s2^-2); infinite where
            a triangle flips, so a start without flips stays without
    W, R    weight and nearest rotation of each triangle in one step [Rabinovich 2017, section 3.2 (SLIM)]

Every quad counts as its four triangles, two for each diagonal: it stays convex, and has no preferred diagonal.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from pipeline.meshes import F64, Indices, Mask

STEPS, ENOUGH = 60, 1e-5  # steps, and the relative fall of the energy that ends them
TINY = 1e-9


def corner_triangles(quads: Indices) -> Indices:
    """(4 Q, 3): the triangle at each corner of each quad."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], quads[:, [0, 1, 3]], quads[:, [1, 2, 3]]])


def rest_shapes(points: F64, triangles: Indices, scale: F64) -> F64:
    """(T, 2, 2) edges from the first corner as columns, in the triangle's plane, times its `scale` (T,)."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    x, side = b - a, c - a
    length = np.maximum(np.linalg.norm(x, axis=1), TINY)
    along = (side * x).sum(1) / length
    across = np.maximum(np.linalg.norm(np.cross(x, side), axis=1) / length, TINY)
    out = np.zeros((len(triangles), 2, 2))
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 1] = length, along, across
    return out * scale[:, None, None]


def tutte(sides: Indices, count: int, fixed: Mask, at: F64) -> F64:
    """(count, 2) each free vertex in the middle of its neighbours along `sides` (n, 2); the `fixed` (count,) stay at
    `at` (count, 2). With the border on a convex outline all faces are convex [Tutte 1963]."""
    a, b = np.concatenate([sides, sides[:, ::-1]]).T
    graph = csc_array(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)))
    graph.data[:] = 1.0  # a side that two quads share counts once
    laplace = csc_array(coo_array((graph.sum(1), (np.arange(count), np.arange(count))), shape=(count, count)) - graph)
    out = at.copy()
    right = -(laplace[:, fixed] @ at[fixed])[~fixed]
    out[~fixed] = splu(csc_array(laplace[:, ~fixed][~fixed])).solve(right)
    return out


def relaxed(points: F64, quads: Indices, scale: F64, start: F64, held: Mask, steps: int = STEPS) -> F64:
    """(n, 2) of least energy near a start (n, 2) without flips. points (n, 3); scale (Q,) wanted texture length over
    length in space; held (n, 2): coordinates that stay."""
    triangles = corner_triangles(quads)
    rest = rest_shapes(points, triangles, np.tile(scale, 4))
    area = np.abs(np.linalg.det(rest))
    inverse = np.linalg.inv(rest)
    uv, energy = start.copy(), _energy(start, triangles, inverse, area)
    if not np.isfinite(energy):
        raise SystemExit("the start of a chart has flipped quads")
    for _ in range(steps):
        way = _proxy(uv, triangles, inverse, area, held) - uv
        step = min(1.0, 0.9 * _farthest(uv, way, triangles))
        before = energy
        while step > 1e-8:
            energy = _energy(uv + step * way, triangles, inverse, area)
            if energy < before:
                break
            step *= 0.6
        if not energy < before:
            break
        uv = uv + step * way
        if before - energy < ENOUGH * before:
            break
    return uv


def _jacobians(uv: F64, triangles: Indices, inverse: F64) -> F64:
    a, b, c = uv[triangles].transpose(1, 0, 2)
    return np.asarray(np.stack([b - a, c - a], 2) @ inverse, np.float64)


def _energy(uv: F64, triangles: Indices, inverse: F64, area: F64) -> float:
    J = _jacobians(uv, triangles, inverse)
    det = np.linalg.det(J)
    if (det <= 0).any():
        return np.inf
    return float((area * (J * J).sum((1, 2)) * (1 + 1 / det**2)).sum())


def _proxy(uv: F64, triangles: Indices, inverse: F64, area: F64, held: Mask) -> F64:
    """(n, 2) argmin sum_t area |W (J - R)|^2."""
    U, s, Vt = np.linalg.svd(_jacobians(uv, triangles, inverse))
    gain = np.sqrt((s + 1) * (s**2 + 1) / s**3)  # (s - s^-3) / (s - 1), which has no value at 1
    W = (U * gain[:, None, :]) @ U.transpose(0, 2, 1) * np.sqrt(area)[:, None, None]
    R = W @ (U @ Vt)
    # row (t, i, k) of W J = sum_j W_ij (sum_c u_cj g_ck), with g the gradient of corner c
    gradient = np.stack([-inverse.sum(1), inverse[:, 0], inverse[:, 1]], 1)  # (T, corner, k)
    value = np.einsum("tij,tck->tikcj", W, gradient)
    rows = np.broadcast_to(np.arange(4 * len(W)).reshape(len(W), 2, 2, 1, 1), value.shape)
    columns = np.broadcast_to(2 * triangles[:, None, None, :, None] + np.arange(2), value.shape)
    A = csc_array(coo_array((value.ravel(), (rows.ravel(), columns.ravel())), shape=(4 * len(W), 2 * len(uv))))
    free = ~held.ravel()
    x = uv.ravel().copy()
    right = R.ravel() - A[:, ~free] @ x[~free]
    some = csc_array(A[:, free])
    normal = csc_array(some.T @ some)
    normal = csc_array(normal + 1e-10 * normal.diagonal().mean() * coo_array(
        (np.ones(normal.shape[0]), (np.arange(normal.shape[0]),) * 2), shape=normal.shape))  # fmt: skip
    x[free] = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve(
        some.T @ right + 1e-10 * normal.diagonal().mean() * x[free]
    )
    return x.reshape(-1, 2)


def _farthest(uv: F64, way: F64, triangles: Indices) -> float:
    """The step along `way` at which the first triangle loses its area."""
    a, b, c = uv[triangles].transpose(1, 0, 2)
    p, q, r = way[triangles].transpose(1, 0, 2)
    d, e, f, g = b - a, c - a, q - p, r - p
    constant, linear, square = _cross(d, e), _cross(d, g) + _cross(f, e), _cross(f, g)
    inside = linear**2 - 4 * square * constant
    root = np.sqrt(np.maximum(inside, 0))
    # the stable form of the smaller positive root
    half = -0.5 * (linear + np.where(linear >= 0, root, -root))
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.stack([half / square, constant / half])
    both = np.where((inside >= 0) & np.isfinite(both) & (both > 0), both, np.inf)
    return float(both.min())


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.float64)


def stretch(points: F64, quads: Indices, uv: F64) -> tuple[F64, F64]:
    """(Q,) L2 stretch of each quad against its own mean scale, 1 where nothing is stretched, and (Q,) the quotient of
    texture area and area in space. points and uv by corner: (Q, 4, 3) and (Q, 4, 2)."""
    n = len(quads)
    flat, corner = uv.reshape(-1, 2), np.arange(4 * n).reshape(n, 4)
    triangles = corner_triangles(corner)
    rest = rest_shapes(points.reshape(-1, 3), triangles, np.ones(4 * n))
    J = _jacobians(flat, triangles, np.linalg.inv(rest)).reshape(4, n, 2, 2)
    weight = np.abs(np.linalg.det(rest)).reshape(4, n)
    s = np.linalg.svd(J, compute_uv=False)
    mean = (weight * (s**2).sum(-1) / 2).sum(0) / weight.sum(0)
    area = (weight * s.prod(-1)).sum(0) / weight.sum(0)
    return np.sqrt(mean / np.maximum(area, 1e-30)), area
