"""The iris: the circle on an eyeball across which the photos become brightest from inside to outside.

Symbols: L brightness of the eye's picture over its median; g a place of the picture, a an angle; C(g, a) the circle of
angle a around g on the ball; M(g, a) the share of the circle that is seen.

    score(g, a) = mean over the seen circle of clip(L(outside) - L(inside), -MOST, MOST) sqrt(M) P(g) P(a)

P prefers the gaze ahead and the usual size of an iris. Inside and outside lie BESIDE a away from the circle.

Source: Daugman 1993, for the circular edge; the lids hide a part of it, so only what is seen counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.eyes.picture import REACH, directions_at, places_of, plane
from pipeline.meshes import F32, F64, Mask

BESIDE = (0.13, 0.06, 0.05)  # of the circle's angle: in the search, and in its two refinements
SIZES = np.linspace(0.88, 1.12, 9)  # of the usual angle
SIZE_SPREAD = 0.15
FARTHEST, STEP = 0.6, 0.04  # radians: gaze from straight ahead, and the grid on which it is searched
GAZE_SPREAD = 0.35
AROUND = 64  # places on a circle
MOST = 1.0
LEAST_SCORE = 0.06  # below it is no edge: eyes in the shade, or too blurred
LEAST_SHOWN = 0.25  # of the circle
LEAST_PIXELS = 6.0  # across the iris


@dataclass(frozen=True, slots=True)
class Iris:
    """gaze (3,): unit direction in the frame of the picture; angle: of the circle, radians; score; shown: share of the
    circle that photos show."""

    gaze: F64
    angle: float
    score: float
    shown: float

    @property
    def found(self) -> bool:
        """Whether there is an edge."""
        return self.score >= LEAST_SCORE and self.shown >= LEAST_SHOWN


def find_iris(colour: F32, weight: F32, usual: float) -> Iris:
    """The iris in a picture (side, side, 3) with weights (side, side), 0 where it is not seen. usual: angle of the
    circle, radians."""
    seen = weight > 0
    light = colour.mean(-1)
    level = float(np.median(light[seen])) if seen.any() else 0.0
    if level <= 0:
        return Iris(np.array([0.0, 0.0, 1.0]), usual, 0.0, 0.0)
    image = smoothed(light / level, seen)
    coarse = STEP * np.arange(-round(FARTHEST / STEP), round(FARTHEST / STEP) + 1, dtype=np.float64)
    best = _best(image, seen, coarse, coarse, SIZES * usual, usual, BESIDE[0])
    for step, beside in zip((STEP / 3, STEP / 10), BESIDE[1:], strict=True):
        near = np.arange(-3, 4, dtype=np.float64) * step
        sizes = np.clip(best[2] + usual * np.linspace(-0.09, 0.09, 13), SIZES[0] * usual, SIZES[-1] * usual)
        best = _best(image, seen, best[0] + near, best[1] + near, sizes, usual, beside)
    gaze = directions_at(np.array(best[:2]))
    return Iris(gaze, best[2], best[3], best[4])


def smoothed(image: F32, seen: Mask) -> F32:
    """(side, side) blurred by a pixel, from seen pixels only."""
    known = seen.astype(np.float32)
    total = cv2.GaussianBlur(np.asarray(image, np.float32) * known, (0, 0), 1.0)
    return np.asarray(total / np.maximum(cv2.GaussianBlur(known, (0, 0), 1.0), 1e-6), np.float32)


def _best(
    image: F32, seen: Mask, across: F64, up: F64, sizes: F64, usual: float, beside: float
) -> tuple[float, float, float, float, float]:
    """Place (x, y), angle, score and seen share of the best circle."""
    places = np.stack(np.meshgrid(across, up), -1).reshape(-1, 2)
    places = places[np.linalg.norm(places, axis=1) <= FARTHEST + 1e-9]
    best = (0.0, 0.0, usual, -1.0, 0.0)
    for angle in sizes:
        inner, in_seen = _around(image, seen, places, angle * (1 - beside))
        outer, out_seen = _around(image, seen, places, angle * (1 + beside))
        both = in_seen & out_seen
        step = np.where(both, np.clip(outer - inner, -MOST, MOST), 0.0)
        shown = both.mean(1)
        prior = np.exp(-0.5 * (np.linalg.norm(places, axis=1) / GAZE_SPREAD) ** 2)
        prior = prior * np.exp(-0.5 * ((angle / usual - 1) / SIZE_SPREAD) ** 2)
        mean = step.sum(1) / np.maximum(both.sum(1), 1)
        score = mean * np.sqrt(shown) * prior
        row = int(score.argmax())
        if score[row] > best[3]:
            best = (*places[row].tolist(), float(angle), float(score[row]), float(shown[row]))
    return best


def _around(image: F32, seen: Mask, places: F64, angle: float) -> tuple[F64, Mask]:
    """(N, AROUND) values and whether they are seen, on circles of an angle around places (N, 2)."""
    z = directions_at(places)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    turn = 2 * np.pi * np.arange(AROUND) / AROUND
    ring = np.cos(angle) * z[:, None] + np.sin(angle) * (
        np.cos(turn)[None, :, None] * x[:, None] + np.sin(turn)[None, :, None] * y[:, None]
    )
    at = places_of(ring)
    side = len(image)
    column = np.round((at[..., 0] / REACH + 1) * side / 2 - 0.5).astype(np.int64)
    row = np.round((1 - at[..., 1] / REACH) * side / 2 - 0.5).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < side) & (row < side)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    return image[row, column].astype(np.float64), np.asarray(inside & seen[row, column])


def angle_from(gaze: F64, side: int) -> F64:
    """(side, side) angle of each pixel of a picture from a gaze (3,), radians."""
    return np.asarray(np.arccos(np.clip(directions_at(plane(side)) @ gaze, -1, 1)))
