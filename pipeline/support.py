"""Finds the support of a subject, a table or a floor, in the sparse points of structure from motion.

Symbols: points (N, 3), origin at the centre of the region of interest, R its radius; plane n . x = o with n towards the
cameras. A support is a plane with many points on it, almost none below it, and the cameras above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.transforms import F64

TRIES = 600
THICK, CLEAR = 0.015, 0.03  # R: points within THICK belong to the support; points above CLEAR do not
MIN_ON, MAX_BENEATH, MIN_ABOVE = 0.08, 0.05, 0.95  # shares: of points on it and below it, of cameras above it
MIN_POINTS = 200
EVEN, ONE_SIDED = 0.25, 0.6  # spread of cameras around a floor's normal: least ratio of its axes, greatest mean


@dataclass(frozen=True, slots=True)
class Support:
    """The plane normal . x = offset that a subject stands on; the normal points up from it."""

    normal: F64
    offset: float


def find_support(points: F64, centres: F64, radius: float, seed: int) -> Support | None:
    """The plane with most points on it that has almost none below and the cameras above, or None.

    points (N, 3); centres (C, 3): of the cameras. The same seed gives the same plane.
    """
    if len(points) < MIN_POINTS:
        return None
    random = np.random.default_rng(seed)
    best, most = None, MIN_ON
    for _ in range(TRIES):
        a, b, c = points[random.choice(len(points), 3, replace=False)]
        n = np.cross(b - a, c - a)
        length = float(np.linalg.norm(n))
        if length < 1e-6 * radius**2:
            continue
        n = n / length * (1 if np.median((centres - a) @ n) > 0 else -1)
        height = (points - a) @ n
        on = float((np.abs(height) < THICK * radius).mean())
        beneath = float((height < -3 * THICK * radius).mean())
        if on > most and beneath <= MAX_BENEATH and float(((centres - a) @ n > 0).mean()) >= MIN_ABOVE:
            best, most = Support(n, float(a @ n)), on
    # if there are no other points, a flat side of the subject could be mistaken for a support
    above = 0 if best is None else int((points @ best.normal - best.offset > CLEAR * radius).sum())
    return best if above >= MIN_POINTS else None


def is_level(support: Support, centres: F64) -> bool:
    """Whether a support is a floor or a table and not a wall: cameras are all around a table, but on one side of a
    wall.

    In the support's plane, the directions to the cameras (C, 3) must spread to all sides and their mean be near 0.
    """
    across = centres - np.outer(centres @ support.normal, support.normal)
    length = np.linalg.norm(across, axis=1)
    unit = across / np.maximum(length, 1e-12)[:, None]
    spread = np.linalg.eigvalsh(unit.T @ unit)  # ascending; the first is along the normal
    return bool(spread[1] > EVEN * spread[2] and np.linalg.norm(unit.mean(0)) < ONE_SIDED)
