"""Similarities between shapes whose points correspond: of two, robustly, and of many to their mean.

Symbols: x, y (V, 3) points; w (V,) weights; s, R, t scale, rotation and translation; N shapes.

    weighted:     min over s, R, t of  sum w |y - (s R x + t)|^2            s = 1 for a rigid motion
    robust:       the same with w / (1 + |r|^2 / c^2) in place of w, in turn; c: 1.4826 times the weighted median of the
                  residuals' lengths |r| (Cauchy's weights)
    on planes:    min sum w f(n . (s R x + t - q)) + TANGENT^2 sum w f(what is across n of s R x + t - y), with q the
                  point nearest to s R x + t among the points y, n its normal, and f as above: points that slid along a
                  smooth surface pull little
    generalised:  min over the shapes' similarities and the mean m of  sum_i sum w_i |s_i R_i x_i + t_i - m|^2
                  with  prod s_i = 1,  by turns

Sources: Umeyama 1991 for the closed form; Holland and Welsch 1977 for the weights; Chen and Medioni 1992 for planes;
Gower 1975 for many shapes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pipeline.meshes import F64
from pipeline.transforms import apply, scale_of, similarity

ROUNDS = 60  # of the robust weights, at most
STEADY = 1e-6  # change of the mean of many shapes, relative to its size, that ends the rounds
SETTLED = 1e-9  # change of a residual, relative to the shape's size, that ends the rounds
TO_DEVIATION = 1.4826  # median of |residual| to the standard deviation of a normal distribution
TANGENT = 0.03  # weight of a distance along the surface over one across it
LEAST_RANK = 1e-6  # second singular value over the first: points with less are on one line


@dataclass(frozen=True, slots=True)
class Aligned:
    """matrix (4, 4): target from source. residual (V,): lengths after it. weights (V,): those of the last round.
    spread: c, the robust standard deviation of the residuals, in the unit of the target."""

    matrix: F64
    residual: F64
    weights: F64
    spread: float


@dataclass(frozen=True, slots=True)
class Mean:
    """matrices (N, 4, 4): mean from shape; mean (V, 3); weights (N, V): those of the last round."""

    matrices: F64
    mean: F64
    weights: F64


def weighted(source: F64, target: F64, weights: F64, *, scaled: bool) -> F64:
    """(4, 4) similarity (rigid motion, if not scaled) of least squares from source (V, 3) to target (V, 3), with
    weights (V,) of a positive sum. It never mirrors.

    Raises:
        ValueError: the weighted points lie on one line, or no weight is positive: no rotation is determined.
    """
    total = float(weights.sum())
    if not (total > 0 and np.isfinite(total)):
        raise ValueError("no weight is positive")
    w = weights / total
    from_, to = w @ source, w @ target
    a, b = source - from_, target - to
    spread = np.linalg.svd((w[:, None] * a).T @ a, compute_uv=False)
    if spread[1] <= LEAST_RANK * spread[0]:
        raise ValueError("the points lie on one line")
    u, values, vt = np.linalg.svd((w[:, None] * b).T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((values * signs).sum() / (w @ (a * a).sum(1))) if scaled else 1.0
    return similarity(scale, rotation, to - scale * rotation @ from_)


def robust(source: F64, target: F64, weights: F64, *, scaled: bool, least: float) -> Aligned:
    """As `weighted`, with Cauchy's weights: points that do not follow count little. least: spread below which
    residuals are noise, in the unit of the target (above 0).

    Raises:
        ValueError: as `weighted`.
    """
    size = float(np.ptp(target, axis=0).max()) or 1.0
    matrix, w, before = weighted(source, target, weights, scaled=scaled), weights, np.full(len(source), np.inf)
    spread = least
    for _ in range(ROUNDS):
        residual = np.linalg.norm(apply(matrix, source) - target, axis=1)
        spread = max(least, TO_DEVIATION * weighted_median(residual, weights))
        w = weights / (1 + (residual / spread) ** 2)
        if np.abs(residual - before).max() < SETTLED * size:
            break
        before = residual
        matrix = weighted(source, target, w, scaled=scaled)
    return Aligned(matrix, np.linalg.norm(apply(matrix, source) - target, axis=1), w, spread)


def on_planes(
    start: F64, source: F64, target: F64, normals: F64, weights: F64, *, scaled: bool, least: float
) -> Aligned:
    """From the similarity start (4, 4) to one that lays source (V, 3) on the surface through target (V, 3) with unit
    normals (V, 3). residual and spread are distances across the surface. Other arguments as in `robust`."""
    tree, use = cKDTree(target), np.flatnonzero(weights > 0)
    x, y, own, w = source[use], target[use], normals[use], weights[use]
    size, matrix = float(np.ptp(target, axis=0).max()) or 1.0, start
    for _ in range(ROUNDS):
        p = apply(matrix, x)
        nearest = tree.query(p)[1]
        n = normals[nearest]
        off, gap = ((p - target[nearest]) * n).sum(1), p - y
        along = gap - (gap * own).sum(1)[:, None] * own
        far = np.linalg.norm(along, axis=1)
        spread, wide = (max(least, TO_DEVIATION * weighted_median(np.abs(r), w)) for r in (off, far))
        middle = w @ p / w.sum()
        across = _moves(p - middle, n[:, None, :], scaled)[:, 0]
        flat = _moves(p - middle, np.eye(3) - own[:, :, None] * own[:, None, :], scaled).reshape(-1, 6 + scaled)
        wa, wf = w / (1 + (off / spread) ** 2), np.repeat(TANGENT**2 * w / (1 + (far / wide) ** 2), 3)
        normal = (across.T * wa) @ across + (flat.T * wf) @ flat
        step = np.linalg.lstsq(normal, -(across.T @ (wa * off) + flat.T @ (wf * along.ravel())), rcond=1e-12)[0]
        turn, grow = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6])) if scaled else 1.0
        matrix = similarity(grow, turn, middle + step[3:6] - grow * turn @ middle) @ matrix
        if np.abs(step[:3]).max() * size + np.abs(step[3:6]).max() < SETTLED * size:
            break
    moved = apply(matrix, source)
    nearest = tree.query(moved)[1]
    off = ((moved - target[nearest]) * normals[nearest]).sum(1)
    spread = max(least, TO_DEVIATION * weighted_median(np.abs(off), weights))
    return Aligned(matrix, np.abs(off), weights / (1 + (off / spread) ** 2), spread)


def _moves(arm: F64, directions: F64, scaled: bool) -> F64:
    """(V, D, 6 or 7) how directions (V, D, 3) of points change with rotation, translation and log scale about their
    middle; arm (V, 3): the points from there."""
    out = [np.cross(arm[:, None, :], directions), directions]
    return np.concatenate(out + [(directions * arm[:, None, :]).sum(2, keepdims=True)] * scaled, 2)


def generalised(shapes: F64, weights: F64, *, scaled: bool, least: float) -> Mean:
    """The mean of shapes (N, V, 3) with weights (N, V), each brought to it by a robust similarity. The mean lies as the
    first shape does, and has the geometric mean of the sizes. N of 1 or more. least: as in `robust`.

    Raises:
        ValueError: as `weighted`, for one of the shapes.
    """
    size, mean = float(np.ptp(shapes[0], axis=0).max()) or 1.0, shapes[0]
    counts = weights
    matrices = np.broadcast_to(np.eye(4), (len(shapes), 4, 4))
    for _ in range(ROUNDS):
        found = [robust(x, mean, w, scaled=scaled, least=least) for x, w in zip(shapes, weights, strict=True)]
        matrices, counts = np.stack([f.matrix for f in found]), np.stack([f.weights for f in found])
        middle = float(np.exp(np.mean([np.log(scale_of(m)) for m in matrices])))
        matrices = np.stack([similarity(1 / middle, np.eye(3), np.zeros(3)) @ m for m in matrices])
        after = averaged(shapes, matrices, counts)
        home = weighted(after, apply(matrices[0], shapes[0]), weights[0], scaled=False)
        moved = np.abs(apply(home, after) - mean).max()
        matrices, mean = home @ matrices, apply(home, after)
        if moved < STEADY * size:
            break
    first = _rigid_part(matrices[0])
    return Mean(first @ matrices, apply(first, mean), counts)


def averaged(shapes: F64, matrices: F64, weights: F64) -> F64:
    """(V, 3) weighted mean of shapes (N, V, 3) after matrices (N, 4, 4); weights (N, V). Where a point has no weight
    in any shape, all count alike."""
    placed = np.stack([apply(m, x) for m, x in zip(matrices, shapes, strict=True)])
    w = np.where(weights.sum(0) > 0, weights, 1.0)
    return np.asarray((w[..., None] * placed).sum(0) / w.sum(0)[:, None], np.float64)


def _rigid_part(matrix: F64) -> F64:
    """(4, 4) that takes a similarity's rotation and translation back: afterwards the first shape is only scaled."""
    scale = scale_of(matrix)
    turn = matrix[:3, :3] / scale
    return similarity(1.0, turn.T, -turn.T @ matrix[:3, 3])


def weighted_median(values: F64, weights: F64) -> float:
    """The least of values (V,) up to which half of the weights (V,) lie; 0 without any."""
    order = np.argsort(values, kind="stable")
    along = np.cumsum(weights[order])
    if not len(along) or along[-1] <= 0:
        return 0.0
    return float(values[order][np.searchsorted(along, 0.5 * along[-1])])
