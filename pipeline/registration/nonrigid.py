"""Deforms the template's skin from the person's identity shape onto the fitted surface.

Symbols: x (V, 3) the cage, p (V, 3) its rest (the identity shape); S_k, n_k the stencil of a limit point and the
surface's normal at the place y_k that it is paired with, w_k its weight; B_l, z_l a landmark's stencil and place;
R_i rotations of the vertices' surroundings; s_e, the stiffness of edge e from i to j; c the stiffness of a step.

    E(x) = sum w_k (n_k . (S_k x - y_k))^2 + sum h_l |B_l x - z_l|^2 + c sum s_e |x_j - x_i - R_e (p_j - p_i)|^2

R_e is the mean of R_i and R_j; R_i takes the edges of i and of its neighbours from rest to now as well as a rotation
can (so that bending costs something too). c falls from step to step; pairs, rotations and x change in turn. Where
nothing is seen only the last term acts: the identity's shape is kept. Where a quad folds or the skin passes through
itself, the surroundings become stiffer, the data count less there, and the steps run again.

Source: Amberg, Romdhani and Vetter, Optimal step nonrigid ICP (2007), for the steps; Sorkine and Alexa,
As-rigid-as-possible surface modeling (2007); Levi and Gotsman, Smooth rotation enhanced ARAP (2015).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Indices, Mask
from pipeline.registration.cage import Cage, part_of, points_of, rows_within
from pipeline.registration.cage_kernels import solved
from pipeline.registration.folds import folded_quads, pierced_quads
from pipeline.registration.outgrown import DRIFT, candidates, outgrown
from pipeline.registration.scan import Scan

# stiffness c, and metres of the template within which a pair counts; each for ROUNDS turns
STEPS = ((30.0, 0.015), (10.0, 0.012), (3.0, 0.010), (1.0, 0.008), (0.3, 0.006), (0.1, 0.005), (0.03, 0.004))
ROUNDS = 3
AGAIN = 3  # first of the steps that run again after a repair: above, nothing folds
SOFT = 0.5  # of the reach: distance at which a pair has half of its weight
LOOSE_REACH = 0.004  # metres: on scalp and neck a surface further away is hair or clothes
LANDMARK = 1.0  # h_l over c of the same step: landmarks guide, and let go with the stiffness
FIXED = 1e-6  # of c: keeps the system positive definite where nothing else does
TOLERANCE, MOST = 0.01, 200  # of the solver: of the residual at its start, which the last round left; steps
REPAIRS, DAMPING = 5, 4.0  # rounds of repair, and factor of the damping around a fault in each
FAULT, EDGE = 2, 3  # rings around a fault that are damped; around what a repair moves, that it needs
FREE = 0.03  # metres of the template around a fault that a repair moves
HELD = 1e6  # of c: keeps what a repair does not move


Steps = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Guides:
    """stencil (L, V), where (L, 3): places of the cage's limit points, or of differences between vertices. least (L,):
    what h does not fall below, 0 for landmarks."""

    stencil: csr_array
    where: F64
    least: F64


@dataclass(frozen=True, slots=True)
class Fitted:
    """vertices (V, 3) of the cage; rotations (V, 3, 3) from rest; folded, pierced: quads that still fold, or pass
    through another; repairs: rounds of them."""

    vertices: F64
    rotations: F64
    folded: int
    pierced: int
    repairs: int


def fitted(cage: Cage, rest: F64, scan: Scan, guides: Guides, unit: float, check: Callable[[], None]) -> Fitted:
    """The cage with rest (V, 3) on the scan. unit: world units per metre of the template."""
    damping, everything = np.ones(len(rest)), np.ones(len(rest), np.bool_)
    near, edges = _around(cage), cage.difference @ rest
    whole = _Part(cage, rest, guides, candidates(cage.points(rest)[cage.grows], scan, DRIFT, unit), everything)
    start = _steps(whole, rest, scan, damping, unit, STEPS[:AGAIN], check)
    x, repairs = _steps(whole, start, scan, damping, unit, STEPS[AGAIN:], check), 0
    while True:
        turn = rotations(cage, edges, cage.difference @ x, near)
        folded, pierced = folded_quads(rest, x, turn, cage.quads), pierced_quads(cage.at_finer @ x, cage.finer) > 0
        if not (folded | pierced).any() or repairs == REPAIRS:
            return Fitted(x, turn, int(folded.sum()), int(pierced.sum()), repairs)
        repairs += 1
        hit = np.zeros(len(rest), np.bool_)
        hit[cage.quads[folded | pierced]] = True
        damping = damping * np.where(_grown(hit, near, FAULT), DAMPING, 1.0)
        free = _with_guides(cKDTree(rest[hit]).query(rest)[0] < FREE * unit, guides)
        keep = _grown(free, near, EDGE)
        x = np.where(free[:, None], start, x)
        part = _part(whole, scan, x, free, keep)
        x[keep] = _steps(part, x[keep], scan, damping[keep], unit, STEPS[AGAIN:], check)


@dataclass(frozen=True, slots=True)
class _Part:
    """cage of some vertices, or of all; rest (V, 3) and guides of these. among: vertices of the surface that may pull
    it; free (V,): those that move."""

    cage: Cage
    rest: F64
    guides: Guides
    among: Indices
    free: Mask


def _part(whole: _Part, scan: Scan, x: F64, free: Mask, keep: Mask) -> _Part:
    """The part of the vertices keep (V,), of which those of free (V,) move; x (V, 3) the whole. A vertex of the surface
    whose nearest place is elsewhere does not pull the part."""
    points = whole.cage.points(x)
    own = np.zeros(len(points), np.bool_)
    own[points_of(whole.cage, keep)] = True
    _, nearest = cKDTree(points).query(scan.mesh.vertices[whole.among])
    guides, use = whole.guides, rows_within(whole.guides.stencil, keep)
    some = Guides(csr_array(guides.stencil[use][:, np.flatnonzero(keep)]), guides.where[use], guides.least[use])
    among = whole.among[own[nearest]]
    return _Part(part_of(whole.cage, keep), whole.rest[keep], some, among, free[keep])


def _with_guides(some: Mask, guides: Guides) -> Mask:
    """(V,) some vertices and those that a guide joins to them: closed lids move together."""
    joined = abs(guides.stencil)
    return np.asarray(some | (joined.T @ (joined @ some.astype(np.float64)) > 0), np.bool_)


def _grown(some: Mask, near: csr_array, rings: int) -> Mask:
    """(V,) some vertices and so many rings of neighbours."""
    for _ in range(rings):
        some = np.asarray(near @ some.astype(np.float64) > 0, np.bool_)
    return some


def _steps(part: _Part, x: F64, scan: Scan, damping: F64, unit: float, steps: Steps, check: Callable[[], None]) -> F64:
    """x (V, 3) after the steps. damping (V,) >= 1: how much less the data count there, and how much stiffer it is."""
    cage, rest, guides = part.cage, part.rest, part.guides
    around, edges = _around(cage), cage.difference @ rest
    size = abs(guides.stencil)
    less = (size @ np.ones(len(x))) / np.maximum(size @ damping, 1e-30)
    trust = 1 / (cage.stencil @ damping)
    cage = replace(cage, stiffness=cage.stiffness * 0.5 * (abs(cage.difference) @ damping))
    held = np.where(part.free, FIXED, HELD)
    springs = csr_array(cage.difference.T @ diags_array(cage.stiffness) @ cage.difference + diags_array(held))
    for c, reach in steps:
        pull = csr_array(guides.stencil.T @ diags_array(less * np.maximum(LANDMARK * c, guides.least)))
        alike = csr_array(c * springs + pull @ guides.stencil)
        for _ in range(ROUNDS):
            check()
            turn = rotations(cage, edges, cage.difference @ x, around)
            found = _data(cage, x, scan, trust, reach * unit, unit, part.among)
            right = c * (_rigid_right(cage, edges, turn) + held[:, None] * x) + pull @ guides.where
            stencil = csr_array(cage.stencil[found.rows])
            right = right + stencil.T @ ((found.weight * found.offset)[:, None] * found.normals)
            x, _ = solved(alike, stencil, found.normals, found.weight, np.ascontiguousarray(right), x, TOLERANCE, MOST)
    return x


@dataclass(frozen=True, slots=True)
class _Data:
    """Of the points that have a pair: weight (N,), normals (N, 3) and offset (N,) of the planes, rows (N,)."""

    weight: F64
    normals: F64
    offset: F64
    rows: Indices


def _data(cage: Cage, x: F64, scan: Scan, trust: F64, reach: float, unit: float, among: Indices) -> _Data:
    far = reach if scan.beneath is None else max(reach, STEPS[0][1] * unit)
    points, facing, shown = cage.points(x), cage.normals(x), np.flatnonzero(cage.shown)
    pairs = scan.pairs(points[shown], facing[shown], far)
    limit = np.where(pairs.hair, far, np.where(cage.loose[shown], min(LOOSE_REACH * unit, reach), reach))
    weight = trust[shown] * pairs.weight / (1 + (pairs.distance / (SOFT * limit)) ** 2)
    weight[pairs.distance > limit] = 0.0
    use = np.flatnonzero(weight > 1e-5)
    more = outgrown(points, facing, cage.grows, scan, unit, among)
    normals = np.concatenate([pairs.normals[use], more.directions])
    where = np.concatenate([pairs.where[use], more.where])
    return _Data(
        np.concatenate([weight[use], trust[more.rows] * more.weight]), normals, (normals * where).sum(1),
        np.concatenate([shown[use], more.rows]),
    )  # fmt: skip


def rotations(cage: Cage, rest: F64, now: F64, around: csr_array) -> F64:
    """(V, 3, 3) rotations that take the edges rest (E, 3) around each vertex and its neighbours nearest to now."""
    moments = (cage.stiffness[:, None, None] * now[:, :, None] * rest[:, None, :]).reshape(-1, 9)
    total = around @ (abs(cage.difference).T @ moments)
    u, _, v = np.linalg.svd(total.reshape(-1, 3, 3))
    flip = np.linalg.det(u) * np.linalg.det(v) < 0
    u[flip, :, 2] *= -1
    return np.asarray(u @ v, np.float64)


def _around(cage: Cage) -> csr_array:
    """(V, V) 1 for a vertex itself and its neighbours."""
    ends = abs(cage.difference)
    joined = csr_array(ends.T @ ends)
    joined.data[:] = 1.0
    return joined


def _rigid_right(cage: Cage, edges: F64, turn: F64) -> F64:
    """(V, 3) right side of the last term for c = 1."""
    mean = 0.5 * (abs(cage.difference) @ turn.reshape(-1, 9)).reshape(-1, 3, 3)
    wanted = np.einsum("eij,ej->ei", mean, edges)
    return np.asarray(cage.difference.T @ (cage.stiffness[:, None] * wanted))
