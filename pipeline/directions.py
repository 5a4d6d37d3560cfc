"""Counts how many cameras see surface that faces each direction, on a grid of elevation and azimuth.

Asset coordinates: azimuth around +Y from +Z (the face, if it is known) towards +X (the person's own left), elevation
above the horizon, degrees. A direction represents a piece of surface that faces it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.transforms import matrix

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Counts = tuple[tuple[int, ...], ...]

ROWS, COLUMNS = 12, 24  # bins of 15 degrees; row 0 is at the top, the front is between columns 11 and 12
STEEP = 60.0  # degrees from its normal up to which a piece of surface is seen well enough to be fitted
BAND = 45.0  # degrees of elevation: above is the top, below is the underside
FRONT = 60.0  # degrees to both sides


AROUND = 0.75  # largest length of the mean of the unit directions to cameras all around: it is 0, of half a circle 0.64


def from_around(centres: F64) -> bool:
    """Whether cameras with these centres (N, 3) stand around the origin: then silhouettes bound a hull on all sides."""
    directions = centres / np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-9)
    return float(np.linalg.norm(directions.mean(0))) <= AROUND


def elevations() -> F64:
    """(ROWS,) elevations of the rows' centres in degrees, from the top."""
    return 90.0 - (np.arange(ROWS) + 0.5) * 180.0 / ROWS


def azimuths() -> F64:
    """(COLUMNS,) azimuths of the columns' centres in degrees, from -180 (the back) over 0 (the front)."""
    return (np.arange(COLUMNS) + 0.5) * 360.0 / COLUMNS - 180.0


def grid() -> F64:
    """(ROWS, COLUMNS, 3) unit vectors of the bins' centres."""
    e, a = np.meshgrid(np.radians(elevations()), np.radians(azimuths()), indexing="ij")
    return np.stack([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)], -1)


def view_directions(cameras: Sequence[Camera]) -> F64:
    """(N, 3) unit vectors from the asset's origin to the cameras."""
    centres = np.array([matrix(c.world_from_cam)[:3, 3] for c in cameras]).reshape(-1, 3)
    return np.asarray(centres / np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-12), np.float64)


def count_seen(directions: F64) -> Counts:
    """(ROWS, COLUMNS) number of views (N, 3) within STEEP degrees of the normal of surface that faces each bin.
    Occlusion is not considered."""
    near = grid() @ directions.T >= np.cos(np.radians(STEEP)) - 1e-9
    return tuple(tuple(int(n) for n in row) for row in near.sum(-1))


def parts() -> dict[str, Bool]:
    """(ROWS, COLUMNS) masks of the named parts of a head. They may overlap."""
    e, a = np.meshgrid(elevations(), azimuths(), indexing="ij")
    band = np.abs(e) <= BAND
    return {
        "front": band & (np.abs(a) <= FRONT),
        "left side": band & (a >= 45) & (a <= 135),
        "right side": band & (a <= -45) & (a >= -135),
        "back": band & (np.abs(a) >= 135),
        "top": e > BAND,
        "underside": e < -BAND,
    }


def around() -> Bool:
    """(ROWS, COLUMNS) mask of the bins within BAND of the horizon, which every photographer can reach."""
    return np.broadcast_to((np.abs(elevations()) <= BAND)[:, None], (ROWS, COLUMNS))


def share_seen(counts: Counts, where: Bool, views: int = 1) -> float:
    """Share of the area of the bins `where` (ROWS, COLUMNS) that at least `views` views see."""
    weight = np.cos(np.radians(elevations()))[:, None] * where
    return float((weight * (np.array(counts) >= views)).sum() / weight.sum())


def spread(directions: F64) -> float:
    """Largest angle between two of the views (N, 3), degrees."""
    if len(directions) < 2:
        return 0.0
    return float(np.degrees(np.arccos((directions @ directions.T).clip(-1, 1).min())))
