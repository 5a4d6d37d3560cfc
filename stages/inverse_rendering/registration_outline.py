"""What the silhouettes tell about a photo's registration.

    e_k(xi) = d_photo(u_k) - d_model(u_k) + n_k . (project(T x_k) - project(x_k))

Symbols: u_k a block within a block and a half of the model's outline; d signed distances to the outlines of mask and
model in blocks, negative inside; n_k the model's outward normal there; x_k the nearest surface point that the model
shows. Both distances are of silhouettes cut at an opacity of a half, so that the error of the cut is the same in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.maths.rigid_motion import motion_matrix
from pipeline.transforms import apply

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
I64 = npt.NDArray[np.int64]

NEAR = 1.6  # blocks from the model's outline
FAR = 12.0  # blocks: where the mask's outline is further away, they are not the same outline
REACH = 6.0  # blocks from the outline to the surface point
BORDER = 3  # blocks at the picture's edge, where a silhouette is cut
LEAST, ALIKE = 0.5, 20.0  # smallest standard deviation in blocks; blocks along the outline whose residuals are alike
FINER = 4  # of a block, where distances are measured: in whole blocks a small motion is no motion for robust weights
TUKEY = 4.0  # standard deviations from which a residual has no weight
FEWEST = 15  # blocks of a half


class Seer(Protocol):
    """A camera, its pictures counted in blocks."""

    def seen(self, points: F64) -> F64:
        """(N, 2) positions of points (N, 3)."""
        ...

    def slope(self, points: F64) -> F64:
        """(N, 2, 6) their derivative by a further motion."""
        ...


@dataclass(frozen=True, slots=True)
class Outline:
    """K blocks at the model's outline: x (K, 3), their positions u (K, 2), normals n (K, 2), the residual e (K,)
    without a motion, and the half (K,) of the chessboard."""

    x: F64
    u: F64
    n: F64
    e: F64
    half: I64

    def equations(self, camera: Seer, xi: F64, half: int) -> tuple[F64, F64]:
        """Normal equations (6, 6), (6,) for a further motion, with Tukey's weights."""
        own = self.half == half
        if own.sum() < FEWEST:
            return np.zeros((6, 6)), np.zeros(6)
        moved, n = apply(motion_matrix(xi), self.x[own]), self.n[own]
        e = self.e[own] + (n * (camera.seen(moved) - self.u[own])).sum(1)
        s = max(1.4826 * float(np.median(np.abs(e - np.median(e)))), LEAST)
        rows = np.einsum("nk,nkj->nj", n, camera.slope(moved))
        weight = np.where(np.abs(e) < TUKEY * s, (1 - (e / (TUKEY * s)) ** 2) ** 2, 0.0) / (s * s * ALIKE)
        return (rows * weight[:, None]).T @ rows, (rows * weight[:, None]).T @ e


def outline_of(
    camera: Seer, mask: F32, opacity: F32, x: F64, surface: Bool, trusted: Bool, square: int
) -> Outline | None:
    """The outline of a sight, None if there is none to compare. All (h, w): mask and opacity in [0, 1], x (h, w, 3)
    where `surface`, trusted where the mask may be compared. square: blocks along a square of the chessboard."""
    model, photo = _distance(opacity), _distance(mask)
    band = (np.abs(model) < NEAR) & (np.abs(photo) < FAR) & trusted
    band[:BORDER] = band[-BORDER:] = False
    band[:, :BORDER] = band[:, -BORDER:] = False
    if not surface.any() or not band.any():
        return None
    row, column = np.nonzero(band)
    at_row, at_column = (k[band] for k in _nearest(surface))
    close = np.hypot(at_row - row, at_column - column) < REACH
    row, column, at_row, at_column = (k[close] for k in (row, column, at_row, at_column))
    down, right = np.gradient(cv2.GaussianBlur(model, (0, 0), 1.0))
    n = np.stack([right[row, column], down[row, column]], -1).astype(np.float64)
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)
    points = np.asarray(x[at_row, at_column], np.float64)
    half = (row // square + column // square) % 2
    e = (photo - model)[row, column].astype(np.float64)
    return Outline(points, camera.seen(points), n, e, half.astype(np.int64)) if len(points) else None


def _distance(alpha: F32) -> F32:
    """(h, w) signed distance to the outline, where alpha is a half, in blocks, negative inside."""
    h, w = alpha.shape
    finer = cv2.resize(alpha.astype(np.float32), (w * FINER, h * FINER), interpolation=cv2.INTER_LINEAR)
    own = (finer > 0.5).astype(np.uint8)
    out, within = (cv2.distanceTransform(k, cv2.DIST_L2, 5) for k in (1 - own, own))
    signed = (out - within).reshape(h, FINER, w, FINER).mean((1, 3)) / FINER
    return np.asarray(signed, np.float32)


def _nearest(surface: Bool) -> tuple[I64, I64]:
    """(h, w) row and column of the nearest block of the surface."""
    _, label = cv2.distanceTransformWithLabels(
        (~surface).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    row, column = np.nonzero(surface)
    rows, columns = (np.zeros(int(label.max()) + 1, np.int64) for _ in range(2))
    rows[label[row, column]], columns[label[row, column]] = row, column
    return rows[label], columns[label]
