"""Standard deviation of a lens's principal point by linear error propagation: do the photos determine it?

Symbols: r = u - project(lens, pose, point) of L observations, pixels; J its derivatives by lens (f, cx, cy, k1), by
pose (6 per photo: rotation and translation) and by point (3 each). With H = J^T J and the points eliminated,
    S = H_xx - H_xp H_pp^-1 H_px,      covariance of lens and poses = s^2 S^-1,      s^2 = sum r^2 / (2 L - unknowns)
(Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, section 9). The 7 gauge freedoms of the world do not affect
the lenses; a weak prior keeps S regular.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from pipeline.transforms import F64

STEP = 1e-6
PRIOR = 1e-10  # of each unknown's diagonal element of S
LENS, POSE = 4, 6


@dataclass(frozen=True, slots=True)
class Observations:
    """L observations of points in photos. photo, point: (L,) indices; uv: (L, 2) pixels; lens_of: (N,) lens of each
    photo."""

    photo: npt.NDArray[np.int64]
    point: npt.NDArray[np.int64]
    uv: F64
    lens_of: npt.NDArray[np.int64]


def project_all(lens: F64, aspect: F64, cam_from_world: F64, points: F64) -> F64:
    """(L, 2) pixels. lens (L, 4): f, cx, cy, k1; aspect (L,): fy / fx; cam_from_world (L, 3, 4); points (L, 3)."""
    p = np.einsum("nij,nj->ni", cam_from_world[:, :, :3], points) + cam_from_world[:, :, 3]
    xy = p[:, :2] / p[:, 2:]
    xy = xy * (1 + lens[:, 3:] * (xy * xy).sum(1, keepdims=True))
    return np.stack([lens[:, 0] * xy[:, 0] + lens[:, 1], lens[:, 0] * aspect * xy[:, 1] + lens[:, 2]], 1)


def principal_point_deviation(
    K: F64, k1: F64, cam_from_world: F64, points: F64, seen: Observations
) -> F64:  # fmt: skip
    """(lenses, 2) standard deviations of cx and cy in pixels if they were refined; infinite if undetermined.

    K (N, 3, 3), k1 (N,), cam_from_world (N, 3, 4) by photo; points (M, 3).
    """
    i, j = seen.photo, seen.point
    lens = np.stack([K[:, 0, 0], K[:, 0, 2], K[:, 1, 2], k1], 1)[i]
    aspect, pose, x = (K[:, 1, 1] / K[:, 0, 0])[i], cam_from_world[i], points[j]
    residual = seen.uv - project_all(lens, aspect, pose, x)

    def by(lens_step: F64, pose_step: tuple[int, float], point_step: F64, h: float) -> F64:
        """Central difference of the projection, (L, 2)."""
        ahead, behind = (
            project_all(lens + sign * lens_step, aspect, _moved(pose, pose_step[0], sign * pose_step[1]),
                        x + sign * point_step) for sign in (1.0, -1.0)
        )  # fmt: skip
        return np.asarray((ahead - behind) / (2 * h), np.float64)

    still, unit = (0, 0.0), np.eye(4)
    lens_steps = [STEP * 1e3] * 3 + [STEP]  # pixels; k1 has no unit
    columns_lens = [by(h * unit[k], still, np.zeros(3), h) for k, h in enumerate(lens_steps)]
    columns_pose = [by(np.zeros(4), (k, STEP), np.zeros(3), STEP) for k in range(POSE)]
    columns_point = [by(np.zeros(4), still, STEP * np.eye(3)[k], STEP) for k in range(3)]
    photos, lenses = len(K), int(seen.lens_of.max()) + 1
    of_lens = seen.lens_of[i]
    by_camera = _sparse([(columns_pose, i * POSE), (columns_lens, photos * POSE + of_lens * LENS)],
                  photos * POSE + lenses * LENS)  # fmt: skip
    by_point = _sparse([(columns_point, j * 3)], 3 * len(points))
    S = _schur(by_camera, by_point, len(points))
    freedom = max(2 * len(i) - by_camera.shape[1] - by_point.shape[1] + 7, 1)
    variance = float((residual**2).sum()) / freedom
    size = np.sqrt(np.maximum(np.diag(S), 1e-300))  # rotations and pixels differ in size
    covariance = np.linalg.inv(S / np.outer(size, size) + PRIOR * np.eye(len(S))) * variance / np.outer(size, size)
    first = photos * POSE + np.arange(lenses) * LENS
    diagonal = np.diag(covariance)
    return np.asarray(np.sqrt(np.maximum(np.stack([diagonal[first + 1], diagonal[first + 2]], 1), 0)), np.float64)


def _moved(pose: F64, k: int, h: float) -> F64:
    """Poses (L, 3, 4) rotated about (k < 3, radians) or shifted along (k >= 3) a camera axis by h."""
    out = pose.copy()
    if k >= 3:
        out[:, k - 3, 3] += h
        return out
    a, b = (k + 1) % 3, (k + 2) % 3
    c, s = np.cos(h), np.sin(h)
    out[:, a], out[:, b] = c * pose[:, a] - s * pose[:, b], s * pose[:, a] + c * pose[:, b]
    return out


def _sparse(blocks: Sequence[tuple[list[F64], npt.NDArray[np.int64]]], width: int) -> sparse.csr_matrix:
    """(2 L, width) Jacobian from blocks: derivatives (L, 2), and each observation's first column (L,)."""
    rows, columns, values = [], [], []
    for derivatives, first in blocks:
        for k, d in enumerate(derivatives):
            for axis in range(2):
                rows.append(2 * np.arange(len(d)) + axis)
                columns.append(first + k)
                values.append(d[:, axis])
    height = 2 * len(blocks[0][0][0])
    at = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix((np.concatenate(values), at), shape=(height, width))


def _schur(by_camera: sparse.csr_matrix, by_point: sparse.csr_matrix, points: int) -> F64:
    """H_xx - H_xp H_pp^-1 H_px, dense; H_pp is block diagonal with blocks of 3 x 3."""
    H_pp = (by_point.T @ by_point).tocoo()
    blocks = np.zeros((points, 3, 3))
    blocks[H_pp.row // 3, H_pp.row % 3, H_pp.col % 3] = H_pp.data
    blocks += np.eye(3) * (1e-12 * np.trace(blocks, axis1=1, axis2=2)[:, None, None] + 1e-300)
    inverse = sparse.bsr_matrix((np.linalg.inv(blocks), np.arange(points), np.arange(points + 1)))
    H_px = by_point.T @ by_camera
    return np.asarray((by_camera.T @ by_camera - H_px.T @ (inverse @ H_px)).todense(), np.float64)
