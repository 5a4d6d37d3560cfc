"""Triangle meshes as plain arrays: files, normals and checks of the topology.

Symbols: V vertices (V, 3), F faces (F, 3) vertex indices, counter-clockwise seen from outside. Lengths are in the
caller's unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Mesh:
    """vertices (V, 3) float32, normals (V, 3) float32 unit, faces (F, 3) int32."""

    vertices: F32
    normals: F32
    faces: Faces


@dataclass(frozen=True, slots=True)
class Charts:
    """Texture coordinates: uvs (U, 2) float32, origin bottom left; faces (F, 3) int32 into uvs, rows as the mesh's."""

    uvs: F32
    faces: Faces


@dataclass(frozen=True, slots=True)
class Topology:
    """Topology of a mesh. `watertight`: every edge has two faces, which use it in opposite directions."""

    watertight: bool
    boundary_edges: int
    crowded_edges: int
    pinched_vertices: int
    components: int
    euler: int

    @property
    def manifold(self) -> bool:
        """Closed, and every vertex has one fan of faces."""
        return self.watertight and self.pinched_vertices == 0

    @property
    def sound(self) -> bool:
        """A manifold that may have a border."""
        return self.components > 0 and self.crowded_edges == 0 and self.pinched_vertices == 0


def save(path: Path, mesh: Mesh, charts: Charts | None = None) -> None:
    """Write the npz of the Surface and UvMesh artifacts."""
    arrays = {"vertices": mesh.vertices, "normals": mesh.normals, "faces": mesh.faces}
    if charts is not None:
        arrays |= {"uvs": charts.uvs, "uv_faces": charts.faces}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def load(path: Path) -> Mesh:
    """The mesh of an npz written by `save`."""
    with np.load(path, allow_pickle=False) as z:
        return Mesh(z["vertices"], z["normals"], z["faces"])


def load_charts(path: Path) -> Charts:
    """The texture coordinates of an npz written by `save`. Raises KeyError if it holds none."""
    with np.load(path, allow_pickle=False) as z:
        return Charts(z["uvs"], z["uv_faces"])


def joined(parts: Sequence[tuple[Mesh, Charts]]) -> tuple[Mesh, Charts]:
    """One mesh of several with their charts, which keep their tiles."""
    moved, laid, at, uv_at = [], [], 0, 0
    for mesh, charts in parts:
        moved.append(mesh.faces + at)
        laid.append(charts.faces + uv_at)
        at, uv_at = at + len(mesh.vertices), uv_at + len(charts.uvs)
    meshes_, charts_ = zip(*parts, strict=True)
    whole = Mesh(
        np.concatenate([m.vertices for m in meshes_]),
        np.concatenate([m.normals for m in meshes_]),
        np.concatenate(moved).astype(np.int32),
    )
    return whole, Charts(np.concatenate([c.uvs for c in charts_]), np.concatenate(laid).astype(np.int32))


def area_vectors(vertices: npt.NDArray[np.floating], faces: Faces) -> F64:
    """(F, 3) vectors along each face's normal, with its area as length."""
    a, b, c = np.asarray(vertices, np.float64)[faces].transpose(1, 0, 2)
    out: F64 = 0.5 * np.cross(b - a, c - a)
    return out


def areas(vertices: npt.NDArray[np.floating], faces: Faces) -> F64:
    """(F,) face areas."""
    out: F64 = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    return out


def volume(vertices: npt.NDArray[np.floating], faces: Faces) -> float:
    """Signed volume of a closed mesh: positive if its faces point outward."""
    a = np.asarray(vertices, np.float64)[faces[:, 0]]
    return float((a * area_vectors(vertices, faces)).sum() / 3)


def vertex_areas(vertices: npt.NDArray[np.floating], faces: Faces) -> F64:
    """(V,) a third of the triangles around each vertex."""
    return np.asarray(np.bincount(faces.ravel(), np.repeat(areas(vertices, faces) / 3, 3), len(vertices)), np.float64)


def vertex_normals(vertices: npt.NDArray[np.floating], faces: Faces) -> F32:
    """(V, 3) unit normals, faces weighted by area. A vertex without faces gets +y."""
    weighted = area_vectors(vertices, faces)
    out = np.stack([np.bincount(faces.ravel(), np.repeat(weighted[:, i], 3), len(vertices)) for i in range(3)], 1)
    return unit(np.asarray(out, np.float64)).astype(np.float32)


def unit(v: npt.NDArray[np.floating]) -> F64:
    """(N, 3) vectors normalised; zero vectors become +y, because a normal needs a direction."""
    w = np.asarray(v, np.float64)
    length = np.linalg.norm(w, axis=1)
    out: F64 = np.where((length > 1e-30)[:, None], w / np.maximum(length, 1e-30)[:, None], [0.0, 1.0, 0.0])
    return out


def triangles_of(quads: Indices) -> Faces:
    """(2 Q, 3): quad q (Q, 4) is triangles 2 q and 2 q + 1, cut from its first to its third corner."""
    return np.asarray(quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), np.int32)


def quads_of(faces: Faces) -> Indices:
    """(F / 2, 4) the quads that `triangles_of` cut into triangles (F, 3)."""
    return np.asarray(faces.reshape(-1, 6)[:, [0, 1, 2, 5]], np.int64)


def whole_quads(faces: Faces, uv_faces: Faces) -> Mask:
    """(F / 2,) pairs of triangles 2 q and 2 q + 1 (F, 3) that are one quad in space and in the texture: both halves
    have the diagonal from the first to the third corner. A pair that a seam of the charts cuts is no quad."""
    halves = [(f[0::2, 0] == f[1::2, 0]) & (f[0::2, 2] == f[1::2, 1]) for f in (faces, uv_faces)]
    return np.asarray(halves[0] & halves[1], np.bool_)


def polygons(faces: Faces, quads: Mask) -> tuple[Indices, Indices]:
    """Corner counts (P,) and all corners (n,) of paired triangles (F, 3) as quads where `quads` (F / 2,), else as two
    triangles each; in the order of the triangles."""
    pair = np.asarray(faces, np.int64).reshape(-1, 6)
    both = np.where(quads[:, None], np.concatenate([quads_of(faces), pair[:, :2]], 1), pair)
    kept = np.arange(6) < np.where(quads, 4, 6)[:, None]
    sizes = np.stack([np.where(quads, 4, 3), np.where(quads, 0, 3)], 1).ravel()
    return sizes[sizes > 0], both[kept]


def fans(counts: Indices) -> Indices:
    """(F, 3) corner indices of the triangles, as fans, of faces with `counts` (P,) corners."""
    start = np.cumsum(counts) - counts
    triangles = counts - 2
    first = np.repeat(start, triangles)
    turn = np.arange(int(triangles.sum())) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.asarray(np.stack([first, first + turn + 1, first + turn + 2], 1), np.int64)


def split_at_seams(faces: Faces, uv_faces: Faces) -> tuple[Indices, Indices, Indices]:
    """Each pair of a vertex and a uv that a corner uses, once, sorted: (N,) vertices, (N,) uvs; and faces (F, 3) of
    pairs. faces, uv_faces (F, 3)."""
    most = int(uv_faces.max(initial=0)) + 1
    pairs, index = np.unique(faces.ravel().astype(np.int64) * most + uv_faces.ravel(), return_inverse=True)
    return pairs // most, pairs % most, np.asarray(index.reshape(faces.shape), np.int64)


def edges(faces: npt.NDArray[np.integer]) -> Indices:
    """(3 F, 2) directed edges, in the order of the faces' sides 0-1, 1-2, 2-0 (all first sides first)."""
    f = np.asarray(faces, np.int64)
    return np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])


def open_edges(faces: npt.NDArray[np.integer], count: int) -> Indices:
    """(B, 2) the `edges` along borders, in their order: those without an opposite one. `count`: vertices."""
    e = edges(faces)
    return np.asarray(e[~np.isin(e[:, 0] * count + e[:, 1], e[:, 1] * count + e[:, 0])])


def unique_edges(faces: Faces) -> Indices:
    """(E, 2) the vertices of each edge once, the lower first, sorted."""
    e = edges(faces)
    if not len(e):
        return e
    count = int(e.max()) + 1  # one number for each edge sorts ten times as fast as rows
    low, high = np.divmod(np.unique(e.min(1) * count + e.max(1)), count)
    return np.stack([low, high], 1)


def paired_edges(faces: Faces, count: int) -> tuple[Indices, Indices, int]:
    """Rows (P,), (P,) of `edges`: the two sides of each edge that two faces share, sorted by the edge's lower, then its
    higher vertex; and the largest number of faces at one edge. Row r belongs to face r % F. `count`: vertices."""
    e = edges(faces)
    code = np.minimum(e[:, 0], e[:, 1]) * count + np.maximum(e[:, 0], e[:, 1])
    order = np.argsort(code, kind="stable")
    first = np.flatnonzero(np.diff(code[order], prepend=-1))
    uses = np.diff(first, append=len(code))
    pair = first[uses == 2]
    return order[pair], order[pair + 1], int(uses.max(initial=0))


def edge_lengths(vertices: npt.NDArray[np.floating], faces: Faces) -> F64:
    """(3 F,) lengths of `edges`."""
    v = np.asarray(vertices, np.float64)
    e = edges(faces)
    out: F64 = np.linalg.norm(v[e[:, 1]] - v[e[:, 0]], axis=1)
    return out


def component_of_face(faces: Faces, count: int) -> Indices:
    """(F,) connected component of each face; faces are connected if they share a vertex. `count`: vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    e = edges(faces)
    graph = coo_array((np.ones(len(e), np.int8), (e[:, 0], e[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label[np.asarray(faces)[:, 0]], np.int64)


def topology(faces: Faces, count: int) -> Topology:
    """The topology of a mesh with `count` vertices. Empty meshes are neither watertight nor manifold."""
    if len(faces) == 0:
        return Topology(False, 0, 0, 0, 0, 0)
    e = edges(faces)
    code = np.minimum(e[:, 0], e[:, 1]) * count + np.maximum(e[:, 0], e[:, 1])
    order = np.argsort(code, kind="stable")
    first = np.flatnonzero(np.diff(code[order], prepend=-1))
    uses = np.diff(first, append=len(code))
    turns = np.add.reduceat(np.where(e[order, 0] < e[order, 1], 1, -1), first)  # 0 where directions are opposite
    boundary, crowded = int((uses == 1).sum()), int(((uses > 2) | ((uses == 2) & (turns != 0))).sum())
    used = np.bincount(faces.ravel(), minlength=count) > 0
    labels = np.bincount(component_of_face(faces, count))
    return Topology(
        watertight=crowded == 0 and boundary == 0,
        boundary_edges=boundary,
        crowded_edges=crowded,
        pinched_vertices=len(_pinched(faces, count, order, np.diff(code[order]) == 0)),
        components=int((labels > 0).sum()),
        euler=int(used.sum()) - len(first) + len(faces),
    )


def _pinched(faces: Faces, count: int, order: Indices, same: Mask) -> Indices:
    """Vertices whose faces form more than one fan (two cones that touch at their tips).

    Corners of faces are joined across shared edges; all corners of a vertex with one fan are then in one group.
    order: of `edges`, so that equal undirected edges are neighbours; same: (3 F - 1,) whether the next one is equal.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    f = np.asarray(faces, np.int64)
    size = len(f)
    corner = np.arange(3 * size).reshape(size, 3)
    start, end = edges(faces).T
    at_start = np.concatenate([corner[:, i] for i in range(3)])
    at_end = np.concatenate([corner[:, (i + 1) % 3] for i in range(3)])
    at_low, at_high = np.where(start < end, at_start, at_end), np.where(start < end, at_end, at_start)
    a, b = order[:-1][same], order[1:][same]
    rows = np.concatenate([at_low[a], at_high[a]])
    columns = np.concatenate([at_low[b], at_high[b]])
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(3 * size, 3 * size))
    fans, fan = connected_components(graph, directed=False)
    vertex = np.empty(fans, np.int64)
    vertex[fan] = f.ravel()
    return np.flatnonzero(np.bincount(vertex, minlength=count) > 1)


def compact(vertices: npt.NDArray[np.floating], faces: Faces) -> tuple[npt.NDArray[np.floating], Faces, Indices]:
    """Drop vertices that no face uses. Returns vertices (V', 3), faces (F, 3) and old indices (V',) of the vertices."""
    used = np.bincount(faces.ravel(), minlength=len(vertices)) > 0
    new = np.cumsum(used) - 1
    return vertices[used], new[faces].astype(np.int32), np.flatnonzero(used)


def split_apart(vertices: F64, faces: Faces) -> tuple[F64, Faces]:
    """Split sheets that touch at an edge with more than two faces or in a point; each gets vertices of its own there.

    Collapsing edges pinches thin handles until two sheets share an edge. Corners of faces keep a common vertex if they
    are neighbours across an edge of two faces; else they become several vertices at the same position.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(faces)
    a, b, _ = paired_edges(faces, len(vertices))  # row r: from corner r // n of face r % n to its next corner
    a_next, b_next = ((r + n) % (3 * n) for r in (a, b))
    one, other = np.concatenate([a, a_next]), np.concatenate([b_next, b])
    graph = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(3 * n, 3 * n))
    corner = np.asarray(connected_components(graph, directed=False)[1], np.int64)
    if corner.max() + 1 == len(np.unique(faces)):
        return vertices, faces
    source = np.zeros(corner.max() + 1, np.int64)
    source[corner] = faces.T.ravel()
    return vertices[source], corner.reshape(3, n).T.astype(np.int32)
