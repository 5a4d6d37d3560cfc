"""Signed distances of shapes with their gradients, and smooth joints between them.

Symbols
    p       points, (3, N), in the length unit of the caller
    d       signed distance (or a first-order approximation of it), (N,), negative inside
    g       gradient of d with respect to the caller's points, (3, N)
    k       width of a smooth joint: the two surfaces influence each other where |a - b| < k

Every shape returns its value and, if its frame requests it, its exact gradient. So the whole head is
differentiated in one pass (forward mode) without finite differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.demo.compiled import compiled

F64 = npt.NDArray[np.float64]
Vector = Sequence[float]

_TINY = 1e-12
_NOTHING: F64 = np.empty((3, 0))  # in place of a gradient that was not requested


@dataclass(frozen=True, slots=True)
class Distance:
    """A sampled distance: `value` (N,), and `gradient` (3, N), or None if it was not requested."""

    value: F64
    gradient: F64 | None

    def __neg__(self) -> Distance:
        return Distance(-self.value, None if self.gradient is None else -self.gradient)


@dataclass(frozen=True, slots=True)
class Frame:
    """Points of a local frame, and how a gradient of that frame returns to the caller's frame.

    `points` (3, N); `pull` maps a local gradient (3, N) to the caller's; None when no gradient is wanted.
    """

    points: F64
    pull: Callable[[F64], F64] | None

    def distance(self, value: F64, gradient: Callable[[], F64]) -> Distance:
        """Wrap a value (N,) and a lazily computed local gradient (3, N)."""
        return Distance(value, None if self.pull is None else self.pull(gradient()))


def plain(points: F64, with_gradient: bool) -> Frame:
    """The caller's own frame."""
    return Frame(points, (lambda g: g) if with_gradient else None)


def mirrored(frame: Frame, softness: float) -> Frame:
    """Fold x onto its positive half: x' = sqrt(x^2 + softness^2).

    The soft fold has no crease at x = 0, so that paired shapes which touch on the midline join smoothly.
    """
    x = frame.points[0]
    folded = np.sqrt(x * x + softness * softness)
    slope = x / folded
    outer = frame.pull

    def pull(g: F64) -> F64:
        assert outer is not None
        return outer(np.stack([g[0] * slope, g[1], g[2]]))

    return Frame(np.stack([folded, frame.points[1], frame.points[2]]), None if outer is None else pull)


def turned(frame: Frame, origin: Vector, local_from_outer: F64) -> Frame:
    """Rigidly moved frame: p' = R (p - origin), with R (3, 3) a rotation."""
    moved = local_from_outer @ (frame.points - _column(origin))
    outer = frame.pull

    def pull(g: F64) -> F64:
        assert outer is not None
        return outer(local_from_outer.T @ g)

    return Frame(moved, None if outer is None else pull)


def wrapped(frame: Frame, axis_z: float, radius: float) -> Frame:
    """Unroll a vertical cylinder: x' is the arc length, y' = y, z' the height above the cylinder.

    The axis passes x = 0, z = `axis_z`. Lengths are true at the radius and stretched by radius / r
    elsewhere; the domain excludes the axis.
    """
    x, y, z = frame.points[0], frame.points[1], frame.points[2] - axis_z
    r = np.sqrt(x * x + z * z + _TINY)
    sine, cosine = x / r, z / r
    outer = frame.pull

    def pull(g: F64) -> F64:
        assert outer is not None
        along = g[0] * (radius / r)
        return outer(np.stack([along * cosine + g[2] * sine, g[1], g[2] * cosine - along * sine]))

    return Frame(np.stack([radius * np.arctan2(x, z), y, r - radius]), None if outer is None else pull)


def arched(frame: Frame, rise: float) -> Frame:
    """Bend the horizontal: y' = y - rise x^2. Stretches lengths by at most 1 + 2 |rise x|."""
    x, y, z = frame.points
    outer = frame.pull

    def pull(g: F64) -> F64:
        assert outer is not None
        return outer(np.stack([g[0] - (2.0 * rise) * x * g[1], g[1], g[2]]))

    return Frame(np.stack([x, y - rise * x * x, z]), None if outer is None else pull)


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> F64:
    """Rotation (3, 3) from angles in radians: roll about z, then pitch about x, then yaw about y."""
    cy, sy = np.cos(yaw), np.sin(yaw)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    about_z = np.array([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_y @ about_x @ about_z, dtype=np.float64)


def ellipsoid(frame: Frame, centre: Vector, radii: Vector) -> Distance:
    """Axis-aligned ellipsoid, exact on the surface to first order.

    d = k0 (k0 - 1) / k1   with k0 = |p / r|, k1 = |p / r^2|
    """
    value, gradient = _ellipsoid(frame.points, _vector(centre), _vector(radii), frame.pull is not None)
    return frame.distance(value, lambda: gradient)


def tube(frame: Frame, knots: Sequence[Vector], radii: Vector) -> Distance:
    """Round tube along a polyline: `knots` (M, 3), `radii` (M,) linear along each piece.

    d = min over pieces of |p - c(t)| - r(t), c(t) the nearest point of the piece.
    """
    ends = np.asarray(knots, dtype=np.float64)
    value, gradient = _tube(frame.points, ends, _vector(radii), frame.pull is not None)
    return frame.distance(value, lambda: gradient)


def half_space(frame: Frame, normal: Vector, offset: float) -> Distance:
    """Half-space n . p < offset, n of unit length."""
    n = _column(normal)
    value = np.asarray(np.sum(n * frame.points, axis=0) - offset)
    return frame.distance(value, lambda: np.broadcast_to(n, frame.points.shape).copy())


def smooth_union(a: Distance, b: Distance, k: float) -> Distance:
    """Cubic smooth minimum, C2: min(a, b) - k h^3 / 6 with h = max(1 - |a - b| / k, 0)."""
    if a.gradient is None or b.gradient is None:
        value, _ = _union(a.value, _NOTHING, b.value, _NOTHING, k)
        return Distance(value, None)
    return Distance(*_union(a.value, a.gradient, b.value, b.gradient, k))


def smooth_cut(a: Distance, b: Distance, k: float) -> Distance:
    """Take `b` out of `a` with a rounded edge: the smooth maximum of a and -b."""
    return -smooth_union(-a, b, k)


def smooth_common(a: Distance, b: Distance, k: float) -> Distance:
    """The part that `a` and `b` share: their smooth maximum."""
    return -smooth_union(-a, -b, k)


def spline(knots: Sequence[Vector], pieces: int) -> list[list[float]]:
    """Catmull-Rom curve through `knots` (M, D), `pieces` straight pieces between two knots."""
    k = np.asarray(knots, dtype=np.float64)
    padded = np.vstack([2 * k[0] - k[1], k, 2 * k[-1] - k[-2]])
    rows: list[list[float]] = []
    for i in range(1, len(padded) - 2):
        for t in np.linspace(0.0, 1.0, pieces, endpoint=False):
            rows.append(_catmull_rom(padded[i - 1 : i + 3], float(t)).tolist())
    rows.append(k[-1].tolist())
    return rows


def _catmull_rom(four: F64, t: float) -> F64:
    a, b, c, d = four
    return np.asarray(
        b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))), dtype=np.float64
    )


def _vector(v: Vector) -> F64:
    return np.asarray(v, dtype=np.float64)


def _column(v: Vector) -> F64:
    return _vector(v)[:, None]


@compiled
def _ellipsoid(p: F64, centre: F64, radii: F64, with_gradient: bool) -> tuple[F64, F64]:
    count = p.shape[1]
    value, gradient = np.empty(count), np.empty((3, count if with_gradient else 0))
    a, b, c = radii[0] ** 2, radii[1] ** 2, radii[2] ** 2
    for n in range(count):
        x, y, z = p[0, n] - centre[0], p[1, n] - centre[1], p[2, n] - centre[2]
        sx, sy, sz = x / a, y / b, z / c
        # The centre itself has no direction; the tiny term keeps it finite (d there is about -min(r)).
        k0 = math.sqrt(x * sx + y * sy + z * sz + _TINY)
        k1 = math.sqrt(sx * sx + sy * sy + sz * sz + _TINY)
        d = k0 * (k0 - 1.0) / k1
        value[n] = d
        if with_gradient:
            rise, fall = (2.0 - 1.0 / k0) / k1, d / (k1 * k1)
            gradient[0, n] = sx * (rise - fall / a)
            gradient[1, n] = sy * (rise - fall / b)
            gradient[2, n] = sz * (rise - fall / c)
    return value, gradient


@compiled
def _tube(p: F64, knots: F64, radii: F64, with_gradient: bool) -> tuple[F64, F64]:
    count = p.shape[1]
    value, gradient = np.full(count, np.inf), np.empty((3, count if with_gradient else 0))
    for i in range(knots.shape[0] - 1):
        ax, ay, az = knots[i + 1] - knots[i]
        length2, widen = ax * ax + ay * ay + az * az, radii[i + 1] - radii[i]
        for n in range(count):
            x, y, z = p[0, n] - knots[i, 0], p[1, n] - knots[i, 1], p[2, n] - knots[i, 2]
            raw = (ax * x + ay * y + az * z) / length2
            t = min(max(raw, 0.0), 1.0)
            x, y, z = x - t * ax, y - t * ay, z - t * az
            dist = math.sqrt(x * x + y * y + z * z + _TINY)
            d = dist - (radii[i] + t * widen)
            if d < value[n]:
                value[n] = d
                if with_gradient:
                    # The nearest point minimises dist, so only the radius feels a change of t.
                    slope = widen / length2 if raw == t else 0.0
                    gradient[0, n] = x / dist - ax * slope
                    gradient[1, n] = y / dist - ay * slope
                    gradient[2, n] = z / dist - az * slope
    return value, gradient


@compiled
def _union(a: F64, grad_a: F64, b: F64, grad_b: F64, k: float) -> tuple[F64, F64]:
    count = a.shape[0]
    value, gradient = np.empty(count), np.empty(grad_a.shape)
    for n in range(count):
        gap = a[n] - b[n]
        h = max(1.0 - abs(gap) / k, 0.0)
        value[n] = min(a[n], b[n]) - (k / 6.0) * h * h * h
        if grad_a.shape[1] > 0:
            # d/da of the correction is half h^2 for the farther operand, and the nearer one gives as much.
            of_a = 0.5 * h * h if gap > 0.0 else 1.0 - 0.5 * h * h
            for i in range(3):
                gradient[i, n] = grad_b[i, n] + of_a * (grad_a[i, n] - grad_b[i, n])
    return value, gradient
