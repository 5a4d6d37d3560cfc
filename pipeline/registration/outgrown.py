"""Where the fitted surface reaches further than the template: the rim of an ear that is larger than the template's.

Pairs from the template to its nearest place on the surface do not show that: a small ear lies well on a large one.
Here the surface's points look for the template instead. Symbols: q a point of the surface that photos see, p the
nearest point of the template with unit normal n, d = (q - p) / |q - p|. q counts if p is on a region that may grow, if
|q - p| lies between COVERED and REACH, and if n . d is at least OUTSIDE: not what is behind or inside of the template,
and not its relief.
The points of one p are drawn together, the far ones more, to one place y: p is pulled along y - p.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.meshes import F32, F64, Indices, Mask, unit
from pipeline.registration.scan import Scan

GROWS = ("ears",)  # regions; elsewhere what reaches further is hair or clothes
ROOT = 0.008  # metres from the rest of the template
COVERED, REACH = 0.0015, 0.015  # metres of the template
OUTSIDE = 0.6  # cosine
SEEN = 0.05  # least sum of cosines of a point that counts
MOST = 20_000  # points of the surface that are asked
DRIFT = 0.02  # metres of the template that an ear moves while it is deformed


@dataclass(frozen=True, slots=True)
class Outgrown:
    """rows (N,) of the template's points; where (N, 3) they are pulled to, along directions (N, 3) only; weight (N,) 0
    to 1 of how well the surface is seen there."""

    rows: Indices
    where: F64
    directions: F64
    weight: F64


def outgrown(
    points: F64, normals: F64, grows: Mask, scan: Scan, scale: float, among: Indices | None = None
) -> Outgrown:
    """Of the template's points (M, 3) with unit normals (M, 3), those that the surface outgrows. grows (M,): those of
    regions that may grow; scale: world units per metre of the template. among: vertices of the surface outside of which
    none is asked (`candidates`); None: all."""
    among = candidates(points[grows], scan, 0.0, scale) if among is None else among
    asked = _around(points[grows], scan, REACH * scale, among)
    if not len(asked):
        return Outgrown(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    q = scan.mesh.vertices[asked].astype(np.float64)
    away, nearest = cKDTree(points).query(q, distance_upper_bound=REACH * scale)
    found = np.isfinite(away) & (away > COVERED * scale)
    found[found] = grows[nearest[found]]
    q, away, nearest, asked = q[found], away[found], nearest[found], asked[found]
    out = ((q - points[nearest]) * normals[nearest]).sum(1) >= OUTSIDE * away
    q, away, nearest, asked = q[out], away[out], nearest[out], asked[out]
    rows, of_row = np.unique(nearest, return_inverse=True)
    share = away**2
    total = np.bincount(of_row, share, len(rows))
    where = np.stack([np.bincount(of_row, share * q[:, k], len(rows)) for k in range(3)], 1) / total[:, None]
    weight = np.bincount(of_row, share * np.minimum(scan.seen[asked], 1.0), len(rows)) / total
    return Outgrown(np.asarray(rows, np.int64), where, unit(where - points[rows]), weight)


def growing(points: F64, ears: Mask) -> Mask:
    """(M,) those of an ear's points (M,) that are away from the rest of the template (M, 3): hair beside the root of an
    ear stands out too. points: of the template itself, metres."""
    if not ears.any() or ears.all():
        return ears
    return np.asarray(ears & (cKDTree(points[~ears]).query(points)[0] > ROOT), np.bool_)


def candidates(points: F64, scan: Scan, drift: float, scale: float) -> Indices:
    """Vertices of the scan that are seen and can pull one of the points (M, 3) while these move by at most `drift`
    metres of the template."""
    seen = np.flatnonzero(scan.seen > SEEN)
    return np.asarray(seen[_in_boxes(scan.mesh.vertices[seen], points, (REACH + drift) * scale)], np.int64)


def _around(points: F64, scan: Scan, reach: float, among: Indices) -> Indices:
    """At most MOST vertices of the scan, of some (n,), that lie within `reach` of the points."""
    if not len(points) or not len(among):
        return np.zeros(0, np.int64)
    near = np.isfinite(cKDTree(points).query(scan.mesh.vertices[among], distance_upper_bound=reach)[0])
    rows = among[near]
    return np.asarray(rows[:: max(1, -(-len(rows) // MOST))], np.int64)


def _in_boxes(vertices: F32, points: F64, reach: float) -> Mask:
    """(V,) vertices within `reach` of the boxes around the points (M, 3) of either side of their middle: few are, and
    only these are compared with points."""
    inside = np.zeros(len(vertices), np.bool_)
    if not len(points):
        return inside
    centred = points - points.mean(0)
    across = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    side = centred @ across > 0
    for own in (points[side], points[~side]):
        if len(own):
            inside |= ((vertices >= own.min(0) - reach) & (vertices <= own.max(0) + reach)).all(1)
    return inside
