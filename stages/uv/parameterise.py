"""Charts from pieces: cuts each piece to a disc, then parameterises it with little stretch.

Symbols
    corner   one corner of a face, 3 f + i; corners that may share a texture vertex are joined across uncut edges
    LSCM     least squares conformal map [Levy 2002, eq. 3]: the start, one sparse solve
    ARAP     as rigid as possible [Liu 2008, section 4]: rotations (local) and positions (global) in alternation
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components, dijkstra

from pipeline.maths.sparse import factorised
from pipeline.meshes import F64, Faces, Indices, Mask
from stages.uv.segment import Dual

RIGID_STEPS = 12
MIN_COTANGENT = 0.02  # least weight of a side: obtuse triangles must not mirror their neighbours
UNFOLD_STEPS = 60
PATHS = 24  # largest number of cuts until a piece is a disc


@dataclass(frozen=True, slots=True)
class Flat:
    """One parameterised chart: its faces (m,) in the mesh, faces (m, 3) into its own vertices, uv (n, 2) and the mesh
    vertex (n,) of each. `good`: a disc without mirrored triangles."""

    member: Indices
    faces: Faces
    uv: F64
    vertex: Indices
    good: bool


def parameterised(vertices: F64, faces: Faces, pairs: Dual, label: Indices, wanted: Mask) -> list[Flat]:
    """Parameterise the pieces of `label` (F,) that are `wanted` (pieces,), in the order of their numbers."""
    cut = np.asarray(label[pairs.a] != label[pairs.b])
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(int(label.max()) + 2))
    inside = np.argsort(np.where(cut, -1, label[pairs.a]), kind="stable")
    begins = np.searchsorted(np.where(cut, -1, label[pairs.a])[inside], np.arange(int(label.max()) + 2))
    out = []
    for i in np.flatnonzero(wanted):
        member = order[starts[i] : starts[i + 1]]
        out.append(_one(vertices, faces, member, _within(pairs, inside[begins[i] : begins[i + 1]], member, len(faces))))
    return out


def _within(pairs: Dual, which: Indices, member: Indices, count: int) -> Dual:
    """The face pairs inside one piece, with the piece's own face indices."""
    row = np.full(count, -1)
    row[member] = np.arange(len(member))
    return Dual(row[pairs.a[which]], row[pairs.b[which]], pairs.edge[which], pairs.length[which], pairs.cost[which])


def _one(vertices: F64, faces: Faces, member: Indices, pairs: Dual) -> Flat:
    own = faces[member].astype(np.int64)
    cut = disc_cuts(own, pairs)
    if cut is None:
        return Flat(member, own.astype(np.int32), np.zeros((0, 2)), np.zeros(0, np.int64), False)
    local, vertex = joined_corners(own, pairs, cut)
    try:
        uv = rigid(vertices[vertex], local, conformal(vertices[vertex], local))
    except RuntimeError:  # a singular matrix: triangles without area
        return Flat(member, own.astype(np.int32), np.zeros((0, 2)), np.zeros(0, np.int64), False)
    uv = unfolded(local, uv)
    return Flat(member, local.astype(np.int32), uv, vertex, bool((signed_areas(uv, local) > 0).all()))


# ------------------------------------------------------------------ topology
def joined_corners(faces: Indices, pairs: Dual, cut: Mask) -> tuple[Indices, Indices]:
    """Faces (m, 3) into texture vertices, and the mesh vertex (n,) of each. Corners are joined across uncut edges."""
    keep = ~cut
    rows: list[Indices] = []
    columns: list[Indices] = []
    for end in (0, 1):
        v = pairs.edge[keep, end]
        for side, out in ((pairs.a[keep], rows), (pairs.b[keep], columns)):
            out.append(3 * side + (faces[side] == v[:, None]).argmax(1))
    r, c = np.concatenate(rows), np.concatenate(columns)
    graph = coo_array((np.ones(len(r), np.int8), (r, c)), shape=(3 * len(faces), 3 * len(faces)))
    count, group = connected_components(graph, directed=False)
    vertex = np.empty(count, np.int64)
    vertex[group] = faces.ravel()
    return np.asarray(group.reshape(-1, 3), np.int64), vertex


def disc_cuts(faces: Indices, pairs: Dual) -> Mask | None:
    """(E,) edges to cut so that a piece becomes a disc; None if PATHS cheapest paths are not enough.

    A path joins two border loops of the piece (including its own cuts), which makes them one.
    """
    cut = np.zeros(len(pairs.a), np.bool_)
    for _ in range(PATHS):
        local, vertex = joined_corners(faces, pairs, cut)
        loop = border_loops(local)
        count = int(loop.max()) + 1
        if count == 1:
            euler = len(vertex) - (3 * len(faces) + int((loop >= 0).sum())) // 2 + len(faces)
            return cut if euler == 1 else None
        if count == 0:
            return None
        path = _path(vertex, loop, pairs, cut)
        if path is None:
            return None
        cut = cut | path
    return None


def border_loops(faces: Indices) -> Indices:
    """(n,) border loop of each texture vertex of faces (m, 3), -1 inside."""
    e = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    n = int(faces.max()) + 1
    there, back = e[:, 0] * n + e[:, 1], e[:, 1] * n + e[:, 0]
    b = e[~np.isin(there, back)]
    graph = coo_array((np.ones(len(b), np.int8), (b[:, 0], b[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    out = np.full(n, -1)
    on = np.unique(b)
    out[on] = np.unique(label[on], return_inverse=True)[1].reshape(-1)
    return np.asarray(out, np.int64)


def _path(vertex: Indices, loop: Indices, pairs: Dual, cut: Mask) -> Mask | None:
    """(E,) edges of the cheapest path from the shortest loop to any other one."""
    ids, inverse = np.unique(vertex, return_inverse=True)
    on = np.full(len(ids), -1)
    on[inverse[loop >= 0]] = loop[loop >= 0]
    ends = np.searchsorted(ids, pairs.edge)
    free = ~cut & ~((on[ends[:, 0]] >= 0) & (on[ends[:, 0]] == on[ends[:, 1]]))
    graph = coo_array((pairs.cost[free] + 1e-12, (ends[free, 0], ends[free, 1])), shape=(len(ids), len(ids))).tocsr()
    sizes = np.bincount(on[on >= 0])
    start = int(np.where(sizes > 0, sizes, len(ids) + 1).argmin())
    distance, before, _ = dijkstra(
        graph, directed=False, indices=np.flatnonzero(on == start), return_predecessors=True, min_only=True
    )
    goals = np.flatnonzero((on >= 0) & (on != start) & np.isfinite(distance))
    if not len(goals):
        return None
    at = int(goals[distance[goals].argmin()])
    code = ends.min(1) * len(ids) + ends.max(1)
    out = np.zeros(len(cut), np.bool_)
    while before[at] >= 0:
        last = int(before[at])
        out |= code == min(at, last) * len(ids) + max(at, last)
        at = last
    return out


# ------------------------------------------------------------------ parameterisation
def local_frames(points: F64, faces: Indices) -> F64:
    """(m, 3, 2) each triangle in its own plane: first corner at 0, second on +x. points (n, 3), faces (m, 3)."""
    p = points[faces]
    x, side = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    length = np.maximum(np.linalg.norm(x, axis=1), 1e-30)
    along = (side * x).sum(1) / length
    across = np.linalg.norm(np.cross(x, side), axis=1) / length
    zero = np.zeros(len(p))
    return np.stack([np.stack([zero, zero], 1), np.stack([length, zero], 1), np.stack([along, across], 1)], 1)


def signed_areas(uvs: F64, faces: npt.NDArray[np.integer]) -> F64:
    """(F,) signed areas of texture triangles: uvs (U, 2), faces (F, 3). Positive: counter-clockwise (u right, v up)."""
    a, b, c = uvs[faces].transpose(1, 0, 2)
    out: F64 = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    return out


def conformal(points: F64, faces: Indices) -> F64:
    """(n, 2) LSCM of points (n, 3) and faces (m, 3), scaled to the surface's area; two distant vertices are pinned.

    sum over triangles of |sum_i W_i U_i|^2 / (2 A),   W_i the opposite side as a complex number, U = u + i v
    """
    frame = local_frames(points, faces)
    z = frame[..., 0] + 1j * frame[..., 1]
    area2 = np.maximum(frame[:, 1, 0] * frame[:, 2, 1], 1e-12 * np.abs(frame).max() ** 2)
    w = np.stack([z[:, 2] - z[:, 1], z[:, 0] - z[:, 2], z[:, 1] - z[:, 0]], 1) / np.sqrt(area2)[:, None]
    n, m = len(points), len(faces)
    rows = np.repeat(np.arange(m), 3)
    system = coo_array((w.ravel(), (rows, faces.ravel())), shape=(m, n)).tocsc()
    first = int(np.linalg.norm(points - points.mean(0), axis=1).argmax())
    second = int(np.linalg.norm(points - points[first], axis=1).argmax())
    free = np.setdiff1d(np.arange(n), [first, second])
    fixed = np.array([0.0, np.linalg.norm(points[second] - points[first])], np.complex128)
    a, b = system[:, free], -(system[:, [first, second]] @ fixed)
    normal = csc_array(a.conj().T @ a)
    u = np.zeros(n, np.complex128)
    u[[first, second]] = fixed
    u[free] = factorised(normal).solve(np.asarray(a.conj().T @ b, np.complex128))
    uv = np.stack([u.real, u.imag], 1)
    scale = np.sqrt(area2.sum() / max(float(2 * np.abs(signed_areas(uv, faces)).sum()), 1e-30))
    return np.asarray(uv * scale, np.float64)


def rigid(points: F64, faces: Indices, start: F64, steps: int = RIGID_STEPS) -> F64:
    """(n, 2) ARAP from a start (n, 2): best rotation of each triangle, then best positions for the rotations."""
    frame = local_frames(points, faces)
    weight = _cotangents(frame)
    n = len(points)
    i, j = faces, np.roll(faces, -1, 1)
    side = frame - np.roll(frame, -1, 1)  # x_i - x_j of each half edge
    rows, columns = np.concatenate([i.ravel(), j.ravel()]), np.concatenate([j.ravel(), i.ravel()])
    both = np.concatenate([weight.ravel()] * 2)
    laplace = csc_array(coo_array((-both, (rows, columns)), shape=(n, n)))
    diagonal = np.bincount(rows, both, n)
    diagonal[0] += diagonal.mean()  # fixes the translation
    solver = factorised(csc_array(laplace + coo_array((diagonal, (np.arange(n), np.arange(n))), shape=(n, n))))
    uv = start - start[0]
    for _ in range(steps):
        edge = uv[i] - uv[j]
        cosine = (weight[..., None] * edge * side).sum((1, 2))
        sine = (weight * (edge[..., 1] * side[..., 0] - edge[..., 0] * side[..., 1])).sum(1)
        length = np.maximum(np.hypot(cosine, sine), 1e-30)
        c, s = (cosine / length)[:, None], (sine / length)[:, None]
        turned = weight[..., None] * np.stack(
            [c * side[..., 0] - s * side[..., 1], s * side[..., 0] + c * side[..., 1]], -1
        )
        right = np.stack(
            [
                np.bincount(i.ravel(), turned[..., k].ravel(), n) - np.bincount(j.ravel(), turned[..., k].ravel(), n)
                for k in (0, 1)
            ],
            1,
        )
        uv = solver.solve(right)
    return np.asarray(uv, np.float64)


def _cotangents(frame: F64) -> F64:
    """(m, 3) cotangent of the angle opposite to side i, i + 1, at least MIN_COTANGENT of the triangle's mean."""
    out = []
    for k in range(3):
        a, b = frame[:, k] - frame[:, (k + 2) % 3], frame[:, (k + 1) % 3] - frame[:, (k + 2) % 3]
        cross = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        out.append((a * b).sum(1) / np.maximum(cross, 1e-30))
    w = np.stack(out, 1).clip(-1e3, 1e3)
    return np.asarray(np.maximum(w, MIN_COTANGENT * np.maximum(np.abs(w).mean(1, keepdims=True), 1.0)), np.float64)


def unfolded(faces: Indices, uv: F64) -> F64:
    """uv (n, 2) with the inner corners of mirrored triangles moved to the mean of their neighbours, repeatedly."""
    e = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    n = len(uv)
    border = border_loops(faces) >= 0
    degree = np.maximum(np.bincount(e[:, 0], minlength=n), 1)[:, None]
    for _ in range(UNFOLD_STEPS):
        wrong = signed_areas(uv, faces) <= 0
        if not wrong.any():
            break
        move = np.zeros(n, np.bool_)
        move[faces[wrong].ravel()] = True
        move &= ~border
        if not move.any():
            break
        middle = np.stack([np.bincount(e[:, 0], uv[e[:, 1], k], n) for k in (0, 1)], 1) / degree
        uv = np.where(move[:, None], middle, uv)
    return uv
