"""Displacement of the subdivided head along its limit normals onto the fitted surface.

Symbols: p, N limit points and normals; t the distance from p along N to the surface, e that to its nearest place. A
point is displaced if the surface there faces as the head does, photos see it, and t <= AGREE e + CLOSE: else the normal
meets another part (the other lip, the lid below). Under hair nothing is displaced outwards, but what would come through
the hair is sunk. Where displaced places pass through each other or turn over, the displacement is taken back. Closed
lips and lids that the data press into each other are moved inwards until they do not, and then meet.
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, Faces, Indices, Mask, area_vectors, triangles_of
from pipeline.meshes import unit as unit_normals
from pipeline.registration.folds import piercing_edges
from pipeline.registration.lips import meeting
from pipeline.registration.scan import Scan

REACH = 0.003  # metres of the template: largest displacement
AGREE, CLOSE = 2.0, 2e-4  # the latter in metres of the template
SPREAD = 2  # rings of quads over which it fades to its borders
DRAW, DRAWN = 5e-5, 16  # metres of the template that closed lips are drawn apart in a round, and rounds
HALVED = 8  # rounds of halving what closes lips and lids
TAKEN_BACK = 6  # rounds of taking it back
TURNED = 0.4  # cosine
EASED = 5  # rings of quads around it, and rounds of smoothing there


def displacement(
    points: F64, normals: F64, quads: Indices, free: Mask, scan: Scan, unit: float, closed: Mask | None = None
) -> tuple[F64, F64]:
    """(n,) metres along normals (n, 3) from points (n, 3), and (n,) how well the place is seen. quads (Q, 4); free
    (Q,): those that may be displaced. unit: world units per metre of the template. closed (Q,): quads of lips and
    lids that are closed, which then meet."""
    signed, seen = scan.along(points, normals, REACH * unit)
    pairs = scan.pairs(points, normals, 2 * REACH * unit)
    agrees = np.isfinite(signed) & (np.abs(np.nan_to_num(signed)) <= AGREE * pairs.distance + CLOSE * unit)
    blocked = np.zeros(len(points), np.bool_)
    blocked[quads[~free]] = True
    use = agrees & (seen > 0) & ~blocked
    moved = np.where(use, np.nan_to_num(signed), 0.0) * _faded(use, quads)
    sunk = np.where(blocked, 0.0, np.minimum(scan.over(points, normals, 2 * REACH * unit), REACH * unit))
    moved = np.where(sunk > 0, np.minimum(moved, -sunk), moved)
    faces = triangles_of(quads[free])
    before, odd = np.unique(piercing_edges(points, faces)), np.zeros(len(points), np.bool_)
    for _ in range(TAKEN_BACK):
        now = points + moved[:, None] * normals
        hit = np.union1d(np.setdiff1d(piercing_edges(now, faces), before), _turned(points, now, faces))
        if not len(hit):
            break
        bad = np.zeros(len(points), np.bool_)
        bad[hit] = True
        odd |= bad
        moved = _eased(moved * _faded(~bad, quads), odd, quads[free])
    if closed is not None and closed.any():
        moved = _apart(points, moved, normals, quads[free], quads[closed], unit)
        moved = moved + _met(points + moved[:, None] * normals, normals, quads, free, closed, unit)
    return moved, np.where(use, seen, 0.0)


def _turned(before: F64, now: F64, faces: Faces) -> Indices:
    """Vertices of faces (F, 3) that the displacement turns by more than TURNED: normals beside a fold of an ear meet
    its other side."""
    was, is_ = (unit_normals(area_vectors(x, faces)) for x in (before, now))
    return np.asarray(np.unique(faces[(was * is_).sum(1) < TURNED]), np.int64)


def _apart(points: F64, moved: F64, normals: F64, quads: Indices, closed: Indices, unit: float) -> F64:
    """The displacement (n,) with what passes through itself in closed lips and lids (C, 4) drawn inwards, until it does
    not: data on either side press them into each other. quads (Q, 4): those that may be displaced."""
    own = np.zeros(len(points), np.bool_)
    own[closed] = True
    quads = quads[own[quads].any(1)]
    for _ in range(DRAWN):
        hit = np.unique(piercing_edges(points + moved[:, None] * normals, triangles_of(quads)))
        if not len(hit):
            return moved
        bad = np.zeros(len(points), np.bool_)
        bad[hit] = True
        bad[quads[bad[quads].any(1)]] = True
        moved = np.where(bad & own, moved - DRAW * unit, moved)
    return moved


def _met(points: F64, normals: F64, quads: Indices, free: Mask, closed: Mask, unit: float) -> F64:
    """(n,) what closes lips and lids (Q,) after everything else; less where they would pass through each other."""
    faces, inner = triangles_of(quads[free]), np.zeros(len(points), np.bool_)
    inner[quads[~free]] = True
    more = np.where(
        inner, 0.0, _smooth(np.where(inner, 0.0, meeting(points, normals, quads[closed], unit)), quads[closed])
    )
    before = np.unique(piercing_edges(points, faces))
    for turn in range(HALVED):
        hit = np.setdiff1d(piercing_edges(points + more[:, None] * normals, faces), before)
        if not len(hit):
            return more
        more[hit] *= 0.5 if turn < HALVED - 2 else 0.0
    return np.zeros(len(points))


def _eased(moved: F64, odd: Mask, quads: Indices) -> F64:
    """The displacement (n,) with the mean of the surroundings within EASED rings of what was taken back, odd (n,): else
    a step is seen around it."""
    near = odd.copy()
    for _ in range(EASED):
        near[quads[near[quads].any(1)]] = True
    for _ in range(EASED if near.any() else 0):
        moved = np.where(near, _smooth(moved, quads), moved)
    return moved


def _smooth(values: F64, quads: Indices) -> F64:
    """(n,) the mean over the quads around each vertex."""
    corners, count = quads.ravel(), len(values)
    total = np.bincount(corners, np.repeat(values[quads].mean(1), 4), count)
    return np.asarray(total / np.maximum(np.bincount(corners, minlength=count), 1))


def _faded(use: Mask, quads: Indices) -> F64:
    """(n,) 1 inside of use (n,), 0 outside, in steps over SPREAD rings between."""
    outside = ~use
    total = (~outside).astype(np.float64)
    for _ in range(SPREAD):
        grown = outside.copy()
        grown[quads[outside[quads].any(1)]] = True
        outside = grown
        total += ~outside
    return total / (SPREAD + 1)
