"""Segments a mesh into charts: pieces with little curvature, whose borders avoid the front of the face.

Symbols, for a set X of faces with areas a and unit normals n
    N_X     sum of a n
    D_X     sum of a less |N_X|: 0 for a flat set, half its area for a hemisphere, all of it for a closed one
    bend    D_X over its area
    w       cost of a metre of border, per edge (seam_weights)

Pieces grow from single faces. In each round two neighbours merge if each is the other's best: the smallest growth of D
for the border that is removed (hierarchical face clustering of Garland 2001, with the border's cost in place of his
shape term). Borders are then straightened by moving single faces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import meshes
from pipeline.least_cut import ENDLESS, least_cut
from pipeline.meshes import F64, Faces, Indices, Mask

FRONT = np.array([0.0, 0.0, 1.0])  # asset coordinates: the subject looks along +Z
FRONT_COST = 12.0  # additional cost of a seam in front; elsewhere it costs 1
FRONT_FROM, FRONT_TO = 0.1, 0.5  # cosines to FRONT between which the cost grows
BEND = 0.4  # largest bend of a chart: a little more than half a cylinder (0.36), less than half a sphere (0.5)
FRONT_BEND = 0.6  # the same if the removed border lies in front: a face reaches from ear to ear
LARGER_BEND = 0.5  # the same if a small piece is merged
MIN_PIECE = 0.012  # of the area: smaller pieces are merged with a neighbour
ROUNDS = 400
ENDS = 0.3  # of a piece's area at each of its ends, when it is split
TOGETHER = 20.0  # times the cost of an edge: of the diagonal of a quad, so that seams go around the quad
FLOW = 20_000  # largest capacity of an edge (integer)
SWEEPS, STRAIGHTEN = 24, 0.06  # of the span: how much border length weighs against bending


@dataclass(frozen=True, slots=True)
class Dual:
    """Pairs of neighbouring faces: a, b (E,), vertices of their edge (E, 2), its length (E,), and length times w."""

    a: Indices
    b: Indices
    edge: Indices
    length: F64
    cost: F64


def seam_weights(vertices: F64, faces: Faces) -> F64:
    """(V,) cost of a seam at each vertex: 1, up to 1 + FRONT_COST where the surface faces the front. vertices (V, 3),
    faces (F, 3)."""
    normals = meshes.vertex_normals(vertices, faces).astype(np.float64)
    t = ((normals @ FRONT - FRONT_FROM) / (FRONT_TO - FRONT_FROM)).clip(0, 1)
    return np.asarray(1 + FRONT_COST * t * t * (3 - 2 * t), np.float64)


def dual(vertices: F64, faces: Faces, weights: F64, *, quads: bool = False) -> Dual:
    """Pairs of faces across the inner edges of a manifold, sorted. vertices (V, 3), faces (F, 3), weights (V,). quads:
    the faces 2 q and 2 q + 1 are a quad; its diagonal costs TOGETHER times as much."""
    first, second, _ = meshes.paired_edges(faces, len(vertices))
    edge = np.sort(meshes.edges(faces)[first], axis=1)
    length = np.linalg.norm(vertices[edge[:, 0]] - vertices[edge[:, 1]], axis=1)
    a, b, cost = first % len(faces), second % len(faces), length * weights[edge].mean(1)
    return Dual(a, b, edge, length, np.where(a // 2 == b // 2, TOGETHER * cost, cost) if quads else cost)


def segment(vertices: F64, faces: Faces, pairs: Dual, *, quads: bool = False) -> Indices:
    """(F,) piece of each face, numbered from 0; every piece is connected. quads: the faces 2 q and 2 q + 1 are a quad,
    which stays in one piece."""
    vectors = meshes.area_vectors(vertices, faces)
    if quads:
        return np.repeat(_segmented(vertices, vectors.reshape(-1, 2, 3).sum(1), _of_quads(pairs)), 2)
    return _segmented(vertices, vectors, pairs)


def _of_quads(pairs: Dual) -> Dual:
    """Pairs of neighbouring quads, from pairs of their halves."""
    a, b = pairs.a // 2, pairs.b // 2
    apart = a != b
    return Dual(a[apart], b[apart], pairs.edge[apart], pairs.length[apart], pairs.cost[apart])


def _segmented(vertices: F64, vectors: F64, pairs: Dual) -> Indices:
    area = np.linalg.norm(vectors, axis=1)
    label = _grown(vectors, area, pairs)
    label = _straightened(label, vectors, area, pairs, float(np.ptp(vertices, axis=0).max()))
    label = connected(label, pairs)
    return _without_fragments(label, vectors, area, pairs)


def connected(label: Indices, pairs: Dual, cut: Mask | None = None) -> Indices:
    """(F,) labels, split where a piece is not connected. `cut` (E,): edges that also separate faces."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    same = label[pairs.a] == label[pairs.b]
    same &= True if cut is None else ~cut
    n = len(label)
    graph = coo_array((np.ones(int(same.sum()), np.int8), (pairs.a[same], pairs.b[same])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def without_fragments(vertices: F64, faces: Faces, label: Indices, pairs: Dual) -> Indices:
    """Pieces (F,) of any origin, with small ones merged into their neighbours."""
    vectors = meshes.area_vectors(vertices, faces)
    return _without_fragments(label, vectors, np.linalg.norm(vectors, axis=1), pairs)


def _bent(normal: F64, area: F64) -> F64:
    return np.asarray(area - np.linalg.norm(normal, axis=-1), np.float64)


def _sums(label: Indices, vectors: F64, area: F64) -> tuple[F64, F64]:
    count = int(label.max()) + 1
    normal = np.stack([np.bincount(label, vectors[:, i], count) for i in range(3)], 1)
    return np.asarray(normal, np.float64), np.asarray(np.bincount(label, area, count), np.float64)


def _borders(label: Indices, pairs: Dual) -> tuple[Indices, Indices, F64, F64]:
    """Neighbouring pieces a < b, the cost of their border, and how much of it lies in front, in [0, 1]."""
    count = int(label.max()) + 1
    a, b = label[pairs.a], label[pairs.b]
    across = a != b
    code = np.minimum(a, b)[across] * count + np.maximum(a, b)[across]
    found, inverse = np.unique(code, return_inverse=True)
    cost, length = (np.bincount(inverse, x[across], len(found)) for x in (pairs.cost, pairs.length))
    front = (cost / np.maximum(length, 1e-30) - 1) / FRONT_COST
    a, b = found // count, found % count
    return a, b, np.asarray(cost, np.float64), np.asarray(front.clip(0, 1), np.float64)


def _grown(vectors: F64, area: F64, pairs: Dual) -> Indices:
    """(F,) pieces after merging mutual best neighbours until none may merge."""
    label = np.arange(len(area))
    for _ in range(ROUNDS):
        normal, size = _sums(label, vectors, area)
        a, b, cost, front = _borders(label, pairs)
        joint = _bent(normal[a] + normal[b], size[a] + size[b])
        most = BEND + (FRONT_BEND - BEND) * front
        growth = joint - _bent(normal[a], size[a]) - _bent(normal[b], size[b])
        score = np.where(joint <= most * (size[a] + size[b]), (growth + 1e-9 * size.sum()) / cost, np.inf)
        chosen = _mutual(a, b, score, len(size))
        if not chosen.any():
            break
        into = np.arange(len(size))
        into[b[chosen]] = a[chosen]
        label = np.unique(into[label], return_inverse=True)[1].reshape(-1)
    return np.asarray(label, np.int64)


def _mutual(a: Indices, b: Indices, score: F64, count: int) -> Mask:
    """Pairs that are the best of both pieces (ties: the first pair)."""
    order = np.lexsort((np.arange(len(score)), score))
    order = order[np.isfinite(score[order])]
    best = np.full(count, -1)
    both, which = np.concatenate([a[order], b[order]]), np.concatenate([order, order])
    rank = np.concatenate([np.arange(len(order))] * 2)
    first = np.lexsort((rank, both))
    keep = first[np.flatnonzero(np.diff(both[first], prepend=-1))]
    best[both[keep]] = which[keep]
    out = np.zeros(len(score), np.bool_)
    out[order] = (best[a[order]] == order) & (best[b[order]] == order)
    return out


def _straightened(label: Indices, vectors: F64, area: F64, pairs: Dual, span: float) -> Indices:
    """Move faces to a neighbour's piece if that costs less: bending + STRAIGHTEN span * border.

    Half of the faces may move in one sweep, so that two neighbours do not swap endlessly.
    """
    n = len(area)
    unit = vectors / np.maximum(area, 1e-30)[:, None]
    faces, others = np.concatenate([pairs.a, pairs.b]), np.concatenate([pairs.b, pairs.a])
    order = np.argsort(faces, kind="stable")
    slot = np.arange(len(order)) - np.searchsorted(faces[order], faces[order])
    sides = int(slot.max(initial=2)) + 1  # 3, or 4 of a quad
    near = np.repeat(np.arange(n)[:, None], sides, 1)  # across a border a face is its own neighbour
    cost = np.zeros((n, sides))
    near[faces[order], slot] = others[order]
    cost[faces[order], slot] = np.concatenate([pairs.cost, pairs.cost])[order]
    for sweep in range(SWEEPS):
        normal, _ = _sums(label, vectors, area)
        axis = meshes.unit(normal)
        theirs = label[near]
        options = np.concatenate([label[:, None], theirs], 1)
        bending = area[:, None] * (1 - np.einsum("fc,foc->fo", unit, axis[options]))
        border = (cost[:, None] * (theirs[:, None] != options[:, :, None])).sum(2)
        best = (bending + STRAIGHTEN * span / len(axis) * border).argmin(1)
        moving = (best > 0) & (np.arange(n) * 2654435761 % 4294967296 % 2 == sweep % 2)
        if sweep > 1 and not moving.any():
            break
        label = np.where(moving, options[np.arange(n), best], label)
    return label


def _without_fragments(label: Indices, vectors: F64, area: F64, pairs: Dual) -> Indices:
    """Pieces below MIN_PIECE of the area go to the neighbour with the costliest border that may take them."""
    total = area.sum()
    for _ in range(ROUNDS):
        normal, size = _sums(label, vectors, area)
        a, b, cost, _ = _borders(label, pairs)
        joint = _bent(normal[a] + normal[b], size[a] + size[b])
        least = np.minimum(size[a], size[b])
        allowed = (least < MIN_PIECE * total) & (joint <= LARGER_BEND * (size[a] + size[b]))
        if not allowed.any():
            break
        pick = np.flatnonzero(allowed)
        pick = pick[np.lexsort((-cost[pick], least[pick]))[0]]
        label = np.where(label == b[pick], a[pick], label)
        label = np.unique(label, return_inverse=True)[1].reshape(-1)
    return np.asarray(label, np.int64)


def halved(place: F64, label: Indices, which: int, area: F64, pairs: Dual) -> Indices:
    """Labels (F,) with piece `which` split in two where the border is cheapest between its two ends, by a minimum cut
    in the graph of its faces.

    place: (F,) coordinate of the faces along the piece; the ends are the first and last ENDS of its area.
    """
    own = np.flatnonzero(label == which)
    row = np.full(len(label), -1)
    row[own] = np.arange(len(own))
    inside = (row[pairs.a] >= 0) & (row[pairs.b] >= 0)
    order = own[np.argsort(place[own], kind="stable")]
    share = np.cumsum(area[order]) / area[order].sum()
    first, last = row[order[share <= ENDS]], row[order[share >= 1 - ENDS]]
    scale = FLOW / pairs.cost[inside].max()
    capacity = np.maximum(pairs.cost[inside] * scale, 1).astype(np.int32)
    pull = np.zeros(len(own), np.int32)
    pull[last] = -ENDLESS
    pull[first] = ENDLESS
    near = least_cut(row[pairs.a[inside]], row[pairs.b[inside]], capacity, pull)
    out = label.copy()
    out[own[~near]] = int(label.max()) + 1
    return out
