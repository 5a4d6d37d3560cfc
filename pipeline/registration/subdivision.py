"""Catmull-Clark subdivision of quads as sparse matrices, and its limit surface.

Symbols: V vertices, E edges, Q quads; v a vertex of valence n, e_j its neighbours along edges, f_j the vertices
opposite to it in its quads, in turn. Borders: `smooth` is USD's `edgeAndCorner` (a cubic B-spline along the border; a
vertex of one quad only stays where it is); `sharp` is USD's face-varying `boundaries` (linear along the border).

    face point    (a + b + c + d) / 4
    edge point    (a + b + F + G) / 4, F and G the two face points;       on a border (a + b) / 2
    vertex point  (n - 2)/n v + sum (e_j + F_j) / n^2;                    on a smooth border 3/4 v + (a + b)/8
    limit         (n^2 v + 4 sum e_j + sum f_j) / (n (n + 5));            on a smooth border (4 v + a + b)/6
    tangents      sum A cos(2 pi j/n) e_j + (cos(2 pi j/n) + cos(2 pi (j+1)/n)) f_j, and the same with sines
                  A = 1 + cos(2 pi/n) + cos(pi/n) sqrt(2 (9 + cos(2 pi/n)))

Source: Catmull and Clark 1978; Halstead, Kass and DeRose, Efficient, fair interpolation using Catmull-Clark surfaces
(1993), for the limit; borders as OpenSubdiv has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.sparse import csr_array, eye_array

from pipeline.meshes import F64, Indices, Mask, unit

Border = Literal["smooth", "sharp"]


@dataclass(frozen=True, slots=True)
class Level:
    """Quads (Q 4^n, 4) after n steps, and the stencil (V', V) of their vertices: each row has weights of sum 1. The
    children of quad q are the rows q 4^n to (q + 1) 4^n."""

    quads: Indices
    stencil: csr_array


@dataclass(frozen=True, slots=True)
class Limit:
    """Stencils (V, V) of the vertices' limit points, and of two tangents there. rough: vertices without tangents
    (corners and irregular places of a border); their normals are those of the quads."""

    point: csr_array
    along: csr_array
    across: csr_array
    rough: Mask
    quads: Indices

    def normals(self, vertices: F64) -> F64:
        """(V, 3) unit normals of the limit surface of vertices (V, 3)."""
        normal = np.cross(self.along @ vertices, self.across @ vertices)
        if self.rough.any():
            normal[self.rough] = corner_normals(self.point @ vertices, self.quads)[self.rough]
        return unit(normal)


@dataclass(frozen=True, slots=True)
class Edges:
    """of_side (Q, 4): edge of the side from corner i to the next; ends (E, 2); border (E,)."""

    of_side: Indices
    ends: Indices
    border: Mask


def edges_of(quads: Indices, count: int) -> Edges:
    """The edges of quads (Q, 4) over `count` vertices. ValueError if more than two quads share one."""
    a, b = quads.ravel().astype(np.int64), np.roll(quads, -1, axis=1).ravel().astype(np.int64)
    key, inverse, uses = np.unique(np.minimum(a, b) * count + np.maximum(a, b), return_inverse=True, return_counts=True)
    if len(uses) and uses.max() > 2:
        raise ValueError("an edge of more than two quads")
    ends = np.stack([key // count, key % count], 1)
    return Edges(inverse.reshape(quads.shape).astype(np.int64), ends, uses == 1)


def subdivided(quads: Indices, count: int, levels: int, border: Border = "smooth") -> Level:
    """Quads (Q, 4) over `count` vertices after so many steps; 0 steps: as they are."""
    level = Level(np.asarray(quads, np.int64), csr_array(eye_array(count, format="csr")))
    for _ in range(levels):
        step = _step(level.quads, level.stencil.shape[0], border)
        level = Level(step.quads, csr_array(step.stencil @ level.stencil))
    return level


def _step(quads: Indices, count: int, border: Border) -> Level:
    """One step: vertex points, then edge points, then face points."""
    edges = edges_of(quads, count)
    e, q = len(edges.ends), len(quads)
    faces = _matrix(np.repeat(np.arange(q), 4), quads.ravel(), np.full(4 * q, 0.25), (q, count))
    ends = _matrix(np.repeat(np.arange(e), 2), edges.ends.ravel(), np.full(2 * e, 0.5), (e, count))
    sides = edges.of_side.ravel()
    beside = _matrix(sides, np.repeat(np.arange(q), 4), np.full(4 * q, 0.25), (e, q)) @ faces
    inner = np.where(edges.border, 0.0, 1.0)
    edge_points = _scaled(1 - 0.5 * inner, ends) + _scaled(inner, beside)
    vertex_points = _vertex_points(quads, count, edges, faces, border)
    v, m, f = quads, count + edges.of_side, count + e + np.arange(q)
    child = np.stack([v, m, np.broadcast_to(f[:, None], v.shape), np.roll(m, 1, axis=1)], 2)
    return Level(child.reshape(-1, 4), _stacked(vertex_points, edge_points, faces))


def _vertex_points(quads: Indices, count: int, edges: Edges, faces: csr_array, border: Border) -> csr_array:
    n = np.bincount(quads.ravel(), minlength=count).astype(np.float64)
    on_border, corner = border_vertices(quads, count, edges)
    inner = np.where(on_border | (n == 0), 0.0, 1.0)
    n = np.maximum(n, 1)
    smooth = np.where(on_border & ~corner, 1.0, 0.0) if border == "smooth" else np.zeros(count)
    own = inner * (n - 2) / n + smooth * 0.75 + (1 - inner - smooth)
    around = _scaled(inner / n**2, _neighbours(edges, count, ~edges.border))
    q = len(quads)
    incident = _matrix(quads.ravel(), np.repeat(np.arange(q), 4), np.ones(4 * q), (count, q))
    beside = _scaled(inner / n**2, csr_array(incident @ faces))
    along = _scaled(smooth / 8, _neighbours(edges, count, edges.border))
    return _scaled(own, csr_array(eye_array(count, format="csr"))) + around + beside + along


def limit(quads: Indices, count: int) -> Limit:
    """The limit surface at the vertices of quads (Q, 4) with smooth borders."""
    edges = edges_of(quads, count)
    n = np.bincount(quads.ravel(), minlength=count).astype(np.float64)
    on_border, corner = border_vertices(quads, count, edges)
    inner, n1 = np.where(on_border | (n == 0), 0.0, 1.0), np.maximum(n, 1)
    smooth = np.where(on_border & ~corner, 1.0, 0.0)
    opposite = _matrix(quads.ravel(), np.roll(quads, 2, axis=1).ravel(), np.ones(quads.size), (count, count))
    scale = inner / (n1 * (n1 + 5))
    point = (
        _scaled(scale * n1**2 + smooth * 4 / 6 + (1 - inner - smooth), csr_array(eye_array(count, format="csr")))
        + _scaled(4 * scale, _neighbours(edges, count, ~edges.border))
        + _scaled(scale, opposite)
        + _scaled(smooth / 6, _neighbours(edges, count, edges.border))
    )
    along, across, regular = _tangents(quads, count, edges, on_border, n)
    return Limit(csr_array(point), along, across, ~regular, np.asarray(quads, np.int64))


def _tangents(quads: Indices, count: int, edges: Edges, on_border: Mask, n: F64) -> tuple[csr_array, csr_array, Mask]:
    """Tangents of all vertices inside, and of those of a border with two quads, where they are those of a B-spline."""
    turn = _place_in_ring(quads, count, edges, on_border)
    v, e, f = (np.roll(quads, -i, axis=1).ravel() for i in range(3))
    use = ~on_border[v]
    v, e, f, j, valence = v[use], e[use], f[use], turn.ravel()[use], n[v[use]]
    step = 2 * np.pi / valence
    A = 1 + np.cos(step) + np.cos(step / 2) * np.sqrt(2 * (9 + np.cos(step)))
    rows, columns = np.concatenate([v, v]), np.concatenate([e, f])
    along, across = (
        _matrix(rows, columns, np.concatenate([A * g(j * step), g(j * step) + g((j + 1) * step)]), (count, count))
        for g in (np.cos, np.sin)
    )
    border_along, border_across, regular = _border_tangents(quads, count, edges, on_border, n)
    return along + border_along, across + border_across, (~on_border & (n > 0)) | regular


def _border_tangents(
    quads: Indices, count: int, edges: Edges, on_border: Mask, n: F64
) -> tuple[csr_array, csr_array, Mask]:
    """At a border's vertex v between a and b, e the neighbour inside, f and g those beside e: b - a in the direction
    that the quads are on its left, and 4 e + f + g - 4 v - a - b."""
    a, b = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    side = edges.border[edges.of_side.ravel()]
    regular = on_border & (n == 2) & (np.bincount(a[side], minlength=count) == 1)
    one = np.ones(int(side.sum()))
    shape = (count, count)
    forward = _matrix(a[side], b[side], one, shape) - _matrix(b[side], a[side], one, shape)
    inside = _neighbours(edges, count, ~edges.border)
    opposite = _matrix(a, np.roll(quads, 2, axis=1).ravel(), np.ones(quads.size), shape)
    ends = _neighbours(edges, count, edges.border)
    inward = 4.0 * inside + opposite - ends - _scaled(np.full(count, 4.0), csr_array(eye_array(count, format="csr")))
    keep = np.where(regular, 1.0, 0.0)
    return _scaled(keep, csr_array(forward)), _scaled(keep, csr_array(inward)), regular


def _place_in_ring(quads: Indices, count: int, edges: Edges, on_border: Mask) -> Indices:
    """(Q, 4) place of each quad among those around its corner, counter-clockwise; from any start, inside only."""
    side = np.arange(quads.size)
    by_edge = np.full((len(edges.ends), 2), -1, np.int64)
    order = np.argsort(edges.of_side.ravel(), kind="stable")
    sorted_edge = edges.of_side.ravel()[order]
    second = np.r_[False, sorted_edge[1:] == sorted_edge[:-1]]
    by_edge[sorted_edge[~second], 0] = order[~second]
    by_edge[sorted_edge[second], 1] = order[second]
    pair = by_edge[edges.of_side.ravel()]
    twin = np.where(pair[:, 0] == side, pair[:, 1], pair[:, 0])
    before = side - side % 4 + (side + 3) % 4  # the side that ends where this one begins
    following = twin[before]
    first = np.full(count, -1, np.int64)
    first[quads.ravel()[::-1]] = side[::-1]
    place = np.full(quads.size, -1, np.int64)
    at = first[(first >= 0) & ~on_border]
    turn = 0
    while len(at):
        place[at] = turn
        at = following[at]
        at = at[(at >= 0) & (place[at] < 0)]
        turn += 1
    return np.asarray(place.reshape(quads.shape), np.int64)


def border_vertices(quads: Indices, count: int, edges: Edges) -> tuple[Mask, Mask]:
    """(V,) on a border; (V,) corners: in one quad only, or where borders meet."""
    uses = np.bincount(edges.ends[edges.border].ravel(), minlength=count)
    n = np.bincount(quads.ravel(), minlength=count)
    return uses > 0, (uses > 0) & ((n == 1) | (uses != 2))


def corner_normals(vertices: F64, quads: Indices) -> F64:
    """(V, 3) sum over the quads of the normals at their corners, not unit."""
    x = vertices[quads]
    after, before = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    normal = np.cross(after, before).reshape(-1, 3)
    return np.stack([np.bincount(quads.ravel(), normal[:, i], len(vertices)) for i in range(3)], 1)


def _neighbours(edges: Edges, count: int, use: Mask) -> csr_array:
    """(V, V) 1 for vertices that an edge of `use` (E,) joins."""
    ends = edges.ends[use]
    rows, columns = ends.ravel(), ends[:, ::-1].ravel()
    return _matrix(rows, columns, np.ones(len(rows)), (count, count))


def _matrix(rows: Indices, columns: Indices, values: F64, shape: tuple[int, int]) -> csr_array:
    return csr_array((values, (rows, columns)), shape=shape)


def _scaled(factors: F64, matrix: csr_array) -> csr_array:
    """The matrix with its rows times factors (N,)."""
    from scipy.sparse import diags_array

    return csr_array(diags_array(factors) @ matrix)


def _stacked(*parts: Any) -> csr_array:
    from scipy.sparse import vstack

    return csr_array(vstack(parts, format="csr"))
