"""Registration of a photo to the model: the rigid motion of the subject that makes the model look like the photo.

    minimise over xi   sum_i rho((I(u_i(xi)) - g m_i - o) / s) / (s^2 A)  +  outline  +  6 xi^T G xi / d^2
    u_i(xi) = u_i + project(T x_i) - project(x_i),      G = mean_i D_i^T D_i,   D_i = d project(T x_i) / d xi

Symbols: i a block of pixels where the model shows the surface point x_i in the brightness m_i (sRGB-encoded mean of the
channels) and the photo has the brightness I; g, o gain and offset of the photo, found anew in each step; s robust
standard deviation of the residuals; A pixels whose residuals are alike; d expected displacement in blocks, weak. xi^T G
xi is the mean squared displacement of the subject in the picture. The outline's term is in registration_outline.py.

Gauss-Newton steps with Tukey's weights, coarse to fine. The gradient is the mean of the photo's and the model's, as in
efficient second-order minimisation (Benhimane and Malis 2004). What the model shows is rendered once.

The blocks are divided into the two colours of a chessboard, and each half is registered alone. Their difference tells
how uncertain the motion is, and each half's motion is judged by the pixels of the other: `Registered`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.maths.rigid_motion import after, motion_matrix, motion_slope
from pipeline.transforms import apply, project, projection_slope
from stages.inverse_rendering.registration_outline import Outline

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
I64 = npt.NDArray[np.int64]

LEVELS = (4, 2, 1)  # blocks of the sight to a side, coarse to fine
STEPS = (6, 4, 3)  # Gauss-Newton steps of each level
SQUARE = 16  # blocks along a square of the chessboard
ALIKE = 27.0  # A: residuals of a model are alike over about 5 x 5 blocks
EXPECTED = 4.0  # d in blocks
BLUR = 0.8  # blocks: cubic splines through a blurred photo keep its noise, so that a motion alone lowers no residual
TUKEY = 4.0  # standard deviations from which a residual has no weight
SMALLEST = 2e-3  # of s, sRGB: half a code of 8 bits
FEWEST = 100  # blocks of a half: with fewer there is no motion
MOST = 12_000  # blocks of the finest level that are used
FARTHEST = 6.0  # blocks: a larger motion is not one that the start can be trusted with
NONE = np.zeros(6)


@dataclass(frozen=True, slots=True)
class Pair:
    """A photo and what the model shows in it, on blocks of `factor` pixels (h, w).

    photo, model: sRGB-encoded brightness. x (h, w, 3): the surface point seen, asset units. usable: where both may be
    compared. K, cam_from_world, distortion: of the photo, at its own size. outline: what their silhouettes tell, None
    if nothing.
    """

    photo: F32
    model: F32
    x: F64
    usable: Bool
    K: F64
    cam_from_world: F64
    distortion: F64
    factor: int
    outline: Outline | None = None

    def seen(self, points: F64) -> F64:
        """(N, 2) positions of points (N, 3) in blocks."""
        return project(self.K, self.cam_from_world, self.distortion, points)[0] / self.factor

    def slope(self, points: F64) -> F64:
        """(N, 2, 6) their derivative by a further motion of the points (N, 3), in blocks."""
        by_point = projection_slope(self.K, self.cam_from_world, self.distortion, points) / self.factor
        return motion_slope(points, by_point)


@dataclass(frozen=True, slots=True)
class Registered:
    """xi: (6,) the motion, from both halves; halves (2, 6) those of each. G: see the module. gain: by how much the
    robust residual of the pixels that were not used falls, a share of what it was, and its standard error; zero and
    infinite without a motion."""

    xi: F64
    halves: F64
    G: F64
    gain: float
    error: float

    @property
    def better(self) -> bool:
        """Whether pixels that were not used confirm the motion."""
        return self.gain > self.error and self.pixels(self.xi) <= FARTHEST

    def pixels(self, xi: F64) -> float:
        """Root mean square displacement of the subject by a motion (6,), in blocks."""
        return float(np.sqrt(max(float(xi @ self.G @ xi), 0.0)))

    @property
    def signal(self) -> float:
        """Mean product of both halves' displacements, square blocks: its expectation is that of the true motion's
        square, because their errors are independent."""
        return float(self.halves[0] @ self.G @ self.halves[1])

    @property
    def noise(self) -> float:
        """Expected squared error of xi, square blocks."""
        apart = self.halves[0] - self.halves[1]
        return float(apart @ self.G @ apart) / 4


NOTHING = Registered(NONE, np.zeros((2, 6)), np.zeros((6, 6)), 0.0, float("inf"))


def register(pair: Pair) -> Registered:
    """Register a photo. A pair with too little to compare gives no motion."""
    if not (np.isfinite(pair.cam_from_world).all() and np.isfinite(pair.K).all()):
        return NOTHING
    pair = _without_nonsense(pair)
    levels = [_level(pair, side) for side in LEVELS]
    finest = levels[-1]
    if min(np.bincount(finest.half, minlength=2)) < FEWEST:
        return NOTHING
    D = pair.slope(finest.x)
    G = np.einsum("nki,nkj->ij", D, D) / len(D)
    halves = np.stack([_solve(pair, levels, G, half) for half in (0, 1)])
    if not np.isfinite(halves).all():
        return NOTHING
    gain, error = _judged(pair, finest, halves)
    return Registered(halves.mean(0), halves, G, gain, error)


def _without_nonsense(pair: Pair) -> Pair:
    """Values that are not finite as 0, and not usable."""
    good = pair.usable & np.isfinite(pair.photo) & np.isfinite(pair.model) & np.isfinite(pair.x).all(-1)
    photo, model = (np.nan_to_num(k, posinf=0.0, neginf=0.0) for k in (pair.photo, pair.model))
    return replace(pair, photo=photo, model=model, usable=good)


# ------------------------------------------------------------------ levels
@dataclass(frozen=True, slots=True)
class _Level:
    """N blocks of one size. spline (h, w): coefficients of the photo; right, down: its gradients; at (N, 2) the blocks'
    places in it; x, m,
    gradient (N, 2): of the model there. half: (N,) colour of the chessboard. side: of a block, in blocks of the
    pair."""

    spline: F64
    right: F32
    down: F32
    at: F64
    x: F64
    m: F64
    gradient: F64
    half: I64
    square: I64
    start: F64
    side: int


def _level(pair: Pair, side: int) -> _Level:
    photo, model = (cv2.GaussianBlur(_reduced(k, side), (0, 0), BLUR) for k in (pair.photo, pair.model))
    usable = _reduced(pair.usable.astype(np.float32), side) == 1
    x = _reduced(np.where(pair.usable[..., None], pair.x, 0.0), side)
    inner = cv2.erode(usable.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0) > 0
    row, column = np.nonzero(inner)
    every = max(len(row) * side * side // MOST, 1) if side == LEVELS[-1] else 1
    row, column = row[::every], column[::every]
    down, right = (np.asarray(g, np.float32) for g in np.gradient(photo))
    model_down, model_right = (g[row, column] for g in np.gradient(model))
    points = np.asarray(x[row, column], np.float64)
    height, width = (row * side // SQUARE).astype(np.int64), (column * side // SQUARE).astype(np.int64)
    return _Level(
        ndimage.spline_filter(photo.astype(np.float64), mode="nearest"), right, down,
        np.stack([column, row], -1).astype(np.float64), points, model[row, column].astype(np.float64),
        np.stack([model_right, model_down], -1).astype(np.float64),
        (height + width) % 2, height * (1 + pair.photo.shape[1] // SQUARE) + width, pair.seen(points), side,
    )  # fmt: skip


def _reduced(image: npt.NDArray[np.floating], side: int) -> npt.NDArray[np.floating]:
    """The mean over blocks of side x side; rows and columns that do not fill a block are left out."""
    h, w = image.shape[0] // side, image.shape[1] // side
    parts = image[: h * side, : w * side].reshape(h, side, w, side, *image.shape[2:])
    return np.asarray(parts.mean((1, 3)), image.dtype)


def _of(level: _Level, keep: Bool) -> _Level:
    """The chosen blocks (N,)."""
    names = ("at", "x", "m", "gradient", "half", "square", "start")
    return replace(level, **{n: getattr(level, n)[keep] for n in names})


# ------------------------------------------------------------------ Gauss-Newton
def _solve(pair: Pair, levels: Sequence[_Level], metric: F64, half: int) -> F64:
    """(6,) the motion of one half of the blocks. metric: G (6, 6)."""
    xi, prior = NONE, 6 * metric / EXPECTED**2 + 1e-9 * np.trace(metric) / 6 * np.eye(6)
    for whole, steps in zip(levels, STEPS, strict=True):
        level = _of(whole, whole.half == half)
        for _ in range(steps if len(level.x) >= FEWEST else 0):
            H, g = _colours(pair, level, xi)
            if pair.outline is not None:
                more, also = pair.outline.equations(pair, xi, half)
                H, g = H + more, g + also
            xi = after(-np.linalg.solve(H + prior, g + prior @ xi), xi)
            if not np.isfinite(xi).all():
                return xi
    return xi


def _colours(pair: Pair, level: _Level, xi: F64) -> tuple[F64, F64]:
    """Normal equations (6, 6), (6,) of the brightness for a further motion."""
    moved, at = _moved(pair, level, xi)
    r, s = _residual(_value(level, at), level.m)
    own = np.stack([_between(k, at) for k in (level.right, level.down)], -1)
    slope = 0.5 * (own + level.gradient) / level.side
    rows = np.einsum("nk,nkj->nj", slope, pair.slope(moved))
    weighted = rows * (tukey(r / s) * level.side**2 / (s * s * ALIKE))[:, None]
    return weighted.T @ rows, weighted.T @ r


def _moved(pair: Pair, level: _Level, xi: F64) -> tuple[F64, F64]:
    """The points after the motion (N, 3), and their places in the level's photo (N, 2)."""
    moved = apply(motion_matrix(xi), level.x)
    return moved, level.at + (pair.seen(moved) - level.start) / level.side


def _value(level: _Level, at: F64) -> F64:
    """(N,) brightness of the photo at column and row (N, 2), by cubic splines."""
    places = np.stack([at[:, 1], at[:, 0]])
    return np.asarray(ndimage.map_coordinates(level.spline, places, order=3, mode="nearest", prefilter=False))


def _between(image: F32, at: F64) -> F64:
    """(N,) bilinear values at column and row (N, 2), the first pixel's centre at 0."""
    x, y = (np.ascontiguousarray(at[:, k : k + 1], np.float32) for k in (0, 1))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0], np.float64)


def _residual(value: F64, m: F64) -> tuple[F64, float]:
    """I - g m - o (N,) with the photo's gain and offset by robust regression, and s."""
    r, ones = value - m, np.ones_like(m)
    r = r - np.median(r)
    for _ in range(2):
        weight = tukey(r / scale_of(r))
        A = np.stack([m, ones], -1) * weight[:, None]
        system = A.T @ np.stack([m, ones], -1) + 1e-9 * len(m) * np.eye(2)
        gain, offset = np.linalg.solve(system, A.T @ value + 1e-9 * len(m) * np.array([1.0, 0.0]))
        r = value - gain * m - offset
    return r, scale_of(r)


def scale_of(r: F64) -> float:
    """Robust standard deviation of residuals, at least SMALLEST."""
    return max(1.4826 * float(np.median(np.abs(r))), SMALLEST)


def tukey(u: F64) -> F64:
    """Tukey's weights of residuals in standard deviations."""
    inside = np.abs(u) < TUKEY
    return np.asarray(np.where(inside, (1 - (u / TUKEY) ** 2) ** 2, 0.0), np.float64)


def tukey_cost(u: F64) -> F64:
    """Tukey's rho of residuals in standard deviations, 1 at most."""
    inside = np.abs(u) < TUKEY
    return np.asarray(np.where(inside, 1 - (1 - (u / TUKEY) ** 2) ** 3, 1.0), np.float64)


# ------------------------------------------------------------------ judgement
def _judged(pair: Pair, level: _Level, halves: F64) -> tuple[float, float]:
    """By how much the cost falls at the pixels of the half that was not used, as a share; and its standard error, from
    the squares of the chessboard."""
    before, gained, square = [], [], []
    for half in (0, 1):
        part = _of(level, level.half == half)
        costs, s = [], 0.0
        for xi in (NONE, halves[1 - half]):
            r, own = _residual(_value(part, _moved(pair, part, xi)[1]), part.m)
            s = s or own  # that of the start
            costs.append(tukey_cost(r / s))
        before.append(costs[0])
        gained.append(costs[0] - costs[1])
        square.append(part.square)
    where, count = np.unique(np.concatenate(square), return_inverse=True, return_counts=True)[1:]
    of_square = np.bincount(where, np.concatenate(gained), len(count))
    total, n = max(float(np.concatenate(before).sum()), 1e-12), len(count)
    if n < 2:
        return 0.0, float("inf")
    return float(of_square.sum()) / total, float(np.sqrt(n) * of_square.std(ddof=1)) / total
