"""The usual colour of what photos show nearby, for places far from the head that none shows.

Clothes, shoulders and long hair have no region of their own, and one median over all of them gives the back of hair
that hangs on a pink shirt the colour of the shirt. So each place takes the median of what photos show around it. The
farther away the nearest seen place is, the wider is the surrounding: a back takes the colour of the whole shirt, and
not that of one fold at its rim.

    r = LEAST + WIDER d

Symbols: d distance from the place to the nearest that photos show; r radius of the surrounding; metres.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.meshes import F64

LEAST, WIDER = 0.02, 1.5
CELL = 0.015  # metres: the median is taken once for each cell, and interpolated
SAMPLES = 5000  # of what photos show
AROUND = 8  # cells that count for a place


def nearby_colours(at: F64, points: F64, albedo: F64) -> F64:
    """(N, 3) the colour at (N, 3), in metres, of the albedo (M, 3) that photos show at points (M, 3), M > 0."""
    if not len(at):
        return np.zeros((0, 3))
    some = np.linspace(0, len(points) - 1, min(len(points), SAMPLES)).astype(np.int64)
    shown, colour = cKDTree(points[some]), albedo[some]
    cell = np.unique(np.floor(at / CELL).astype(np.int64), axis=0) * CELL + 0.5 * CELL
    around = shown.query_ball_point(cell, LEAST + WIDER * shown.query(cell)[0])
    usual = np.stack([np.median(colour[rows], axis=0) for rows in around])
    away, nearest = (x.reshape(len(at), -1) for x in cKDTree(cell).query(at, min(AROUND, len(cell))))
    weight = np.exp(-0.5 * (away / CELL) ** 2)
    return np.asarray(np.einsum("nk,nkc->nc", weight / weight.sum(1, keepdims=True), usual[nearest]))
