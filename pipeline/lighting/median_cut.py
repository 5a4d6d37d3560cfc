"""Converts a lat-long picture into a few distant lamps with the same energy.

The area with the largest weight (half energy, half solid angle, so that a sun is isolated and dim sky is kept) is split
repeatedly into two halves of equal weight. Each area becomes a lamp at its centre of energy. [Debevec 2005, median cut;
the weight of the solid angle is ours]
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.colour import LUMA
from pipeline.errors import StageError
from pipeline.images import HALF_MAX
from pipeline.maths.latlong import latlong_directions, latlong_weights

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Piece = tuple[int, int, int, int]  # rows y0..y1 and columns x0..x1

LARGEST = 1024  # columns: a finer picture is first reduced, with the same energy


def checked_environment(image: F32, name: str) -> F32:
    """(H, 2 H, 3) picture, clipped to finite values. Raises StageError if it has a wrong shape, negative values or NaN,
    or is black."""
    bad = ""
    if image.ndim != 3 or image.shape[2] < 3 or abs(image.shape[1] - 2 * image.shape[0]) > 2:
        bad = f"{image.shape[1]} x {image.shape[0]}, {image.shape[2]} channels"
    elif np.isnan(image).any() or image[..., :3].min() < 0:
        bad = "values that are negative or not a number"
    elif not image[..., :3].max() > 0:
        bad = "black"
    if bad:
        raise StageError(
            "this environment map can't be used",
            where=name,
            value=bad,
            limit="a lat-long picture, twice as wide as high, linear, not negative, not black",
            remedy="use an equirectangular .hdr or .exr file",
        )
    return np.asarray(np.minimum(image[..., :3], HALF_MAX), np.float32)


@dataclass(frozen=True, slots=True)
class Lamps:
    """directions (N, 3) towards the lamps, unit; flux (N, 3) irradiance on a facing surface; spread (N,) approximate
    variance (rad^2) along one axis of each lamp's area, comparable to 1 / kappa of a vMF lobe; solid (N,) its solid
    angle."""

    directions: F32
    flux: F32
    spread: F32
    solid: F32


def lamps(image: F32, count: int) -> Lamps:
    """At most `count` lamps of a picture (H, 2 H, 3). The sum of their irradiances is its integral over the sphere."""
    image = _shrunk(image)
    height, width = image.shape[:2]
    weights = np.broadcast_to(latlong_weights(width, height), (height, width))
    energy = (image.astype(np.float64) @ np.array(LUMA)) * weights
    total = max(float(energy.sum()), 1e-30)
    measure = 0.5 * energy / total + 0.5 * weights / (4 * np.pi)
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = measure.cumsum(0).cumsum(1)
    pieces = _cut((0, height, 0, width), sums, count)
    directions = latlong_directions(width, height)
    where, flux, spread, solid = [], [], [], []
    for y0, y1, x0, x1 in pieces:
        inside = np.s_[y0:y1, x0:x1]
        centre = (directions[inside] * measure[inside][..., None]).sum((0, 1)) / measure[inside].sum()
        length = float(np.linalg.norm(centre))
        where.append(centre / length)
        spread.append(1 - length)
        flux.append((image[inside].astype(np.float64) * weights[inside][..., None]).sum((0, 1)))
        solid.append(weights[inside].sum())
    return Lamps(*(np.array(x, np.float32) for x in (where, flux, spread, solid)))


def _shrunk(image: F32) -> F32:
    """Reduce to at most LARGEST columns, by means over blocks."""
    factor = -(-image.shape[1] // LARGEST)
    if factor == 1:
        return image
    h, w = image.shape[0] // factor, image.shape[1] // factor
    return np.asarray(image[: h * factor, : w * factor].reshape(h, factor, w, factor, -1).mean((1, 3)), np.float32)


def _cut(whole: Piece, sums: F64, count: int) -> list[Piece]:
    held = [(-_share(whole, sums), whole)]
    done: list[Piece] = []
    while held and len(held) + len(done) < count:
        piece = heapq.heappop(held)[1]
        halves = _halves(piece, sums)
        if not halves:
            done.append(piece)
        for half in halves:
            heapq.heappush(held, (-_share(half, sums), half))
    return done + [p for _, p in held]


def _share(piece: Piece, sums: F64) -> float:
    y0, y1, x0, x1 = piece
    return float(sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0])


def _halves(piece: Piece, sums: F64) -> list[Piece]:
    """Split across the longer side (as an arc on the sphere); empty for a single pixel."""
    y0, y1, x0, x1 = piece
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    if (y1 - y0) * (x1 - x0) == 1:
        return []
    tall = (y1 - y0) * np.pi / rows
    wide = (x1 - x0) * 2 * np.pi / columns * np.sin(np.pi * 0.5 * (y0 + y1) / rows)
    if (wide > tall and x1 - x0 > 1) or y1 - y0 == 1:
        line = sums[y1, x0 : x1 + 1] - sums[y0, x0 : x1 + 1]
        at = x0 + _middle(line)
        return [(y0, y1, x0, at), (y0, y1, at, x1)]
    line = sums[y0 : y1 + 1, x1] - sums[y0 : y1 + 1, x0]
    at = y0 + _middle(line)
    return [(y0, at, x0, x1), (at, y1, x0, x1)]


def _middle(line: F64) -> int:
    held = line - line[0]
    return int(np.clip(np.searchsorted(held, held[-1] / 2), 1, len(line) - 2))
