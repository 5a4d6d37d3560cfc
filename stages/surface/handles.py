"""Removes handles of a closed mesh: finds short non-separating loops, cuts the mesh along them, closes both sides.

Symbols
    genus   number of handles, (2 pieces - euler) / 2
    T       tree of shortest paths along edges from a root (Dijkstra)
    C       spanning tree of the faces across edges that are not in T, of those whose loops are longest
    loop    the cycle of an edge that is in neither tree and its two paths in T

Each handle has two loops, one around it and one through it; no sum of them bounds a part of the surface (Eppstein 2003;
Erickson and Whittlesey 2005 for the choice of C). From a distant root the loops are long detours, so further roots are
placed where the loops of the first one close. Disjoint loops that together do not separate the mesh can be cut at the
same time. Every cut removes one handle: it severs the handle or closes its hole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Faces, Indices, Mask

ROOTS = 8  # tried in a round, besides the first
ROUNDS = 64  # each cuts all loops that are disjoint
RINGS = 3  # of vertices around a cut that are smoothed, so that the two caps separate
SMOOTHING = 20  # steps


@dataclass(frozen=True, slots=True)
class Opened:
    """A mesh with fewer handles. moved (M,): vertices that are new or were moved; cut: number of handles removed; left:
    number of handles whose loops are longer than the limit."""

    vertices: F64
    faces: Faces
    moved: Indices
    cut: int
    left: int


@dataclass(frozen=True, slots=True)
class Web:
    """Edges of a closed manifold, sorted: pairs (E, 2) of vertices, lower one first; length (E,); sides (E, 2), the two
    faces, lower one first."""

    pairs: Indices
    length: F64
    sides: Indices
    vertices: int
    faces: int


@dataclass(frozen=True, slots=True)
class Loop:
    """A cycle of vertices (N,), each joined to the next and the last to the first; its total length."""

    vertices: Indices
    length: float
    closing: int  # a vertex of the edge that is in neither tree


def genus(faces: Faces, count: int) -> int:
    """Number of handles of a closed, connected manifold: faces (F, 3), `count` vertices."""
    return (2 - meshes.topology(faces, count).euler) // 2


def without_handles(vertices: F64, faces: Faces, longest: float) -> Opened:
    """Cut every handle for which a loop no longer than `longest` is found, the shortest loops first.

    vertices (V, 3), faces (F, 3): a closed, connected manifold. Vertices keep their positions and indices, except near
    a cut; new vertices are appended.
    """
    first = left = genus(faces, len(vertices))
    touched: list[Indices] = []
    for _ in range(ROUNDS):
        chosen = _chosen(vertices, faces, longest) if left else []
        if not chosen:
            break
        for loop in chosen:
            vertices, faces, caps = _cut(vertices, faces, loop.vertices)
            touched.append(caps)
        left -= len(chosen)
    if not touched:
        return Opened(vertices, faces, np.zeros(0, np.int64), 0, left)
    around = _rings(np.concatenate(touched), faces, len(vertices))
    return Opened(_smoothed(vertices, faces, around), faces, around, first - left, left)


def web(vertices: F64, faces: Faces) -> Web:
    """The edges of a closed manifold: vertices (V, 3), faces (F, 3)."""
    first, second, _ = meshes.paired_edges(faces, len(vertices))
    pairs = np.sort(meshes.edges(faces)[first], axis=1)
    sides = np.sort(np.stack([first, second], 1) % len(faces), axis=1)
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    return Web(pairs, np.asarray(length, np.float64), sides, len(vertices), len(faces))


def loops_from(net: Web, root: int) -> list[Loop]:
    """Two loops for each handle, the shortest first. root: a vertex."""
    distance, before = _paths(net, root)
    low, high = net.pairs.T
    in_tree = (before[low] == high) | (before[high] == low)
    closing = distance[low] + distance[high] + net.length
    found = [_loop(net, int(e), distance, before) for e in _rest(net, in_tree, closing)]
    return sorted(found, key=lambda loop: loop.length)


def _chosen(vertices: F64, faces: Faces, longest: float) -> list[Loop]:
    """Loops no longer than `longest` that share no vertex and together do not separate the mesh, the shortest first."""
    net = web(vertices, faces)
    found = loops_from(net, int(net.pairs[0, 0]))
    for root in list(dict.fromkeys(loop.closing for loop in found))[:ROOTS]:
        found += loops_from(net, root)
    used = np.zeros(len(vertices), np.bool_)
    out: list[Loop] = []
    for loop in sorted(found, key=lambda loop: loop.length):
        if loop.length <= longest and not used[loop.vertices].any() and _whole(net, [*out, loop]):
            used[loop.vertices] = True
            out.append(loop)
    return out


def _whole(net: Web, loops: list[Loop]) -> bool:
    """Whether the mesh stays connected when it is cut along all these loops."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    code = net.pairs[:, 0] * net.vertices + net.pairs[:, 1]
    uncut = np.ones(len(code), np.bool_)
    for loop in loops:
        e = np.sort(np.stack([loop.vertices, np.roll(loop.vertices, -1)], 1), axis=1)
        uncut[np.searchsorted(code, e[:, 0] * net.vertices + e[:, 1])] = False
    a, b = net.sides[uncut].T
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(net.faces, net.faces))
    return int(connected_components(graph, directed=False, return_labels=False)) == 1


def _paths(net: Web, root: int) -> tuple[F64, Indices]:
    """Distance (V,) along edges from the root, and the predecessor (V,) of each vertex, negative at the root."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    cost = np.maximum(net.length, np.finfo(np.float32).tiny)  # in a sparse array, zero means no edge
    graph = coo_array((cost, (net.pairs[:, 0], net.pairs[:, 1])), shape=(net.vertices, net.vertices)).tocsr()
    distance, before = dijkstra(graph, directed=False, indices=root, return_predecessors=True)
    return distance, before.astype(np.int64)


def _rest(net: Web, in_tree: Mask, closing: F64) -> Indices:
    """Edges that are in neither T nor C."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    free = np.flatnonzero(~in_tree)
    rank = np.empty(len(free), np.int64)
    rank[np.argsort(-closing[free], kind="stable")] = np.arange(1, len(free) + 1)  # all different: the tree is unique
    a, b = net.sides[free].T
    # two faces may share two edges; the one of the longer loop is kept, because a sparse array would sum both
    best = np.lexsort((rank, b, a))
    new = np.ones(len(best), np.bool_)
    new[1:] = (np.diff(a[best]) != 0) | (np.diff(b[best]) != 0)
    kept = best[new]
    graph = coo_array((rank[kept].astype(np.float64), (a[kept], b[kept])), shape=(net.faces, net.faces))
    taken = minimum_spanning_tree(graph.tocsr()).data.astype(np.int64)
    out = np.ones(len(free), np.bool_)
    out[np.argsort(rank)[taken - 1]] = False
    return np.asarray(free[out], np.int64)


def _loop(net: Web, edge: int, distance: F64, before: Indices) -> Loop:
    """The loop that an edge closes in T, starting at the lowest common ancestor of its ends."""
    a, b = (int(v) for v in net.pairs[edge])
    way = [a]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    place = {v: i for i, v in enumerate(way)}
    back = [b]
    while back[-1] not in place:
        back.append(int(before[back[-1]]))
    length = distance[a] + distance[b] + net.length[edge] - 2 * distance[back[-1]]
    return Loop(np.asarray(way[: place[back[-1]] + 1] + back[-2::-1], np.int64), float(length), a)


def _cut(vertices: F64, faces: Faces, loop: Indices) -> tuple[F64, Faces, Indices]:
    """Cut the mesh along a loop and close both sides, each by a fan around the mean of the loop."""
    n, count = len(loop), len(vertices)
    faces = faces.copy()
    for i, (face, corner) in enumerate(_right_of(faces, loop)):
        faces[face, corner] = count + i
    twin, middle = count + np.arange(n), count + n
    after, twin_after = np.roll(loop, -1), np.roll(twin, -1)
    left = np.stack([after, loop, np.full(n, middle)], 1)
    right = np.stack([twin, twin_after, np.full(n, middle + 1)], 1)
    centre = vertices[loop].mean(0)
    out = np.concatenate([vertices, vertices[loop], [centre, centre]])
    closed = np.concatenate([faces, left, right]).astype(np.int32)
    return out, closed, np.concatenate([loop, twin, [middle, middle + 1]])


def _right_of(faces: Faces, loop: Indices) -> list[tuple[Indices, Indices]]:
    """For each vertex of the loop: the faces on its right, and which of their corners the vertex is.

    Corners are listed one by one, because a face may lie left of one part of a loop and right of another part.
    """
    near = np.flatnonzero(np.isin(faces, loop).any(1))
    ahead: dict[tuple[int, int], tuple[int, int]] = {}  # directed edge -> its face and the vertex that ends the face
    for f in near.tolist():
        a, b, c = (int(v) for v in faces[f])
        ahead[a, b], ahead[b, c], ahead[c, a] = (f, c), (f, a), (f, b)
    out = []
    for before, v, after in zip(np.roll(loop, 1).tolist(), loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
        right, spoke = [], before
        while spoke != after:
            face, spoke = ahead[v, spoke]
            right.append(face)
        found = np.asarray(right, np.int64)
        out.append((found, np.asarray((faces[found] == v).argmax(1), np.int64)))
    return out


def _rings(seeds: Indices, faces: Faces, count: int) -> Indices:
    """Vertices within RINGS edges of the seeds."""
    inside = np.zeros(count, np.bool_)
    inside[seeds] = True
    for _ in range(RINGS):
        inside[faces[inside[faces].any(1)]] = True
    return np.flatnonzero(inside)


def _smoothed(vertices: F64, faces: Faces, free: Indices) -> F64:
    """Move the free vertices to the mean of their neighbours, SMOOTHING times, all at once."""
    from scipy.sparse import coo_array

    e = meshes.edges(faces)
    row = np.full(len(vertices), -1)
    row[free] = np.arange(len(free))
    e = e[row[e[:, 0]] >= 0]
    neighbours = coo_array((np.ones(len(e)), (row[e[:, 0]], e[:, 1])), shape=(len(free), len(vertices))).tocsr()
    degree = neighbours.sum(1)[:, None]
    out = vertices.copy()
    for _ in range(SMOOTHING):
        out[free] = (neighbours @ out) / degree
    return out
