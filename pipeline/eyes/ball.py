"""An eyeball: a sphere with a cornea in front of the iris, and how it is fitted to the surface between the lids.

Symbols: c centre, R radius of the ball; g unit direction of the gaze; a radius of the iris, which is the circle where
ball and cornea meet; K radius of the cornea; t angle from g.

The cornea is a sphere whose centre lies on the axis at z = sqrt(R^2 - a^2) - sqrt(K^2 - a^2). Its surface lies

    h(t) = z cos t + sqrt(K^2 - z^2 sin^2 t) - R        for sin t < a / R, else 0

outside of the ball. The sphere is the least squares of

    sum_i w_i (|p_i - c| - R)^2 / NOISE^2 + (R - R_0)^2 / SPREAD^2 + |c - c_0|^2 / AWAY^2

with weights that fall with the residual (Cauchy): eyeballs of adults hardly differ in size, and the lids show little of
them.

Source of the measures: Bekerman, Gottlieb and Vaiman 2014, eyeballs of 250 adults (24.2 mm across); Hashemi et al. 2015
and the usual schematic eyes, iris 11.7 mm across, cornea 7.8 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.meshes import F64

RADIUS, IRIS, CORNEA = 0.012, 0.00585, 0.0078  # metres, of an adult
SPREAD = 0.0005  # metres: standard deviation of the radius among persons
AWAY = 0.002  # metres: of the centre from where the skin around it puts it
NOISE = 0.0003  # metres: of the fitted surface
ROUNDS = 20
PATCHES = 8  # errors of the fitted surface between the lids that do not depend on each other
FEWEST = 20  # points that are no evidence for a sphere


@dataclass(frozen=True, slots=True)
class Eye:
    """centre (3,), radius, iris (its radius) in metres of the world; axes (3, 3): rows to the person's left, up, and
    along the gaze."""

    centre: F64
    radius: float
    axes: F64
    iris: float

    def points(self, directions: F64) -> F64:
        """(N, 3) places on the ball in unit directions (N, 3) of the eye's own frame."""
        return np.asarray(self.centre + self.radius * directions @ self.axes)

    def local(self, points: F64) -> F64:
        """(N, 3) unit directions from the centre to points (N, 3), in the eye's own frame."""
        away = (points - self.centre) @ self.axes.T
        return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-30))


def sphere_on(
    points: F64, weights: F64, centre: F64, radius: float, unit: float = 1.0, spread: float = SPREAD
) -> tuple[F64, float]:
    """Centre (3,) and radius of the sphere on points (N, 3) with weights (N,) from 0 to 1, near a centre and a usual
    radius; these themselves with fewer than FEWEST points. unit: world units of one metre; spread: of the radius,
    metres."""
    c, r = centre.astype(np.float64), float(radius)
    if (weights > 0).sum() < FEWEST:
        return c, r
    noise, spread, away = NOISE * unit, spread * unit, AWAY * unit
    share = weights * PATCHES / weights.sum()  # neighbours on the surface err alike: the points count as few
    for _ in range(ROUNDS):
        toward = points - c
        length = np.linalg.norm(toward, axis=1)
        off = (length - r) / noise
        w = share / (1 + (off / 3) ** 2)
        rows = np.c_[-toward / np.maximum(length, 1e-30)[:, None], -np.ones(len(points))] / noise
        a = (rows * w[:, None]).T @ rows
        b = -(rows * w[:, None]).T @ off
        a += np.diag([away**-2] * 3 + [spread**-2])
        b += np.append((centre - c) / away**2, (radius - r) / spread**2)
        step = np.linalg.solve(a, b)
        c, r = c + step[:3], r + float(step[3])
    return c, r


def cornea_height(angle: npt.NDArray[np.floating], radius: float, iris: float, cornea: float) -> F64:
    """(N,) h at angles (N,) from the gaze, radians. Domain: iris < radius and cornea, cornea < radius."""
    z = np.sqrt(radius**2 - iris**2) - np.sqrt(cornea**2 - iris**2)
    t = np.asarray(angle, np.float64)
    inside = t < np.arcsin(iris / radius)
    root = np.sqrt(np.maximum(cornea**2 - (z * np.sin(t)) ** 2, 0))
    return np.asarray(np.where(inside, z * np.cos(t) + root - radius, 0.0))


def turned(axes: F64, gaze: F64) -> F64:
    """(3, 3) axes after the smallest rotation that takes the third of them to a unit direction gaze (3,) of the
    world. Domain: not opposite."""
    z = axes[2]
    v, c = np.cross(z, gaze), float(z @ gaze)
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(axes @ (np.eye(3) + k + k @ k / (1 + c)).T)
