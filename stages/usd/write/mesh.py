"""The asset's mesh in memory, and texture coordinates for proxy and dense mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline import meshes, tiles
from pipeline.errors import StageError
from pipeline.meshes import Charts

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]

SHRINK, SHRINK_ROUNDS = 0.85, 6
SAMPLED = 6  # steps along an edge between the places of a triangle that are tested for overlap: slivers lie at edges
AREAS = (0.25, 4.0)  # accepted ratio of texture area to the triangle's own; others are parameterised again
INSIDE = 1e-5  # of a tile: least distance of corners from its border, against rounding errors
LINE = 1e-14  # of the squared edges: triangles of a smaller squared area are lines
CANDIDATES = 12  # nearest triangles that are searched for the exact nearest point


@dataclass(frozen=True, slots=True)
class UvSurface:
    """Triangles with texture coordinates. vertices, normals (V, 3); faces, uv_faces (F, 3); uvs (U, 2), v up. paired:
    the faces are pairs, and written as quads where no seam cuts them (meshes.whole_quads)."""

    vertices: F32
    normals: F32
    faces: I32
    uvs: F32
    uv_faces: I32
    paired: bool = False


def read_mesh(path: Path, *, with_uvs: bool = True, paired: bool = False) -> UvSurface:
    """Read a mesh npz. Without uvs (a proxy) those arrays are empty. StageError if the arrays do not match."""
    with np.load(path, allow_pickle=False) as f:
        stored = {k: f[k] for k in f.files}
    if not with_uvs:
        stored |= {"uvs": np.zeros((0, 2)), "uv_faces": np.zeros((0, 3))}
    missing = {"vertices", "normals", "faces", "uvs", "uv_faces"} - stored.keys()
    if missing:
        raise _bad_mesh(path, f"no array {', '.join(sorted(missing))}")
    mesh = UvSurface(
        np.asarray(stored["vertices"], np.float32),
        np.asarray(stored["normals"], np.float32),
        np.asarray(stored["faces"], np.int32),
        np.asarray(stored["uvs"], np.float32),
        np.asarray(stored["uv_faces"], np.int32),
        paired,
    )
    fault = _fault(mesh, with_uvs)
    if fault:
        raise _bad_mesh(path, fault)
    return mesh


def _fault(mesh: UvSurface, with_uvs: bool) -> str:
    if not len(mesh.faces):
        return "no triangles"
    if mesh.vertices.shape != mesh.normals.shape or not all(
        np.isfinite(a).all() for a in (mesh.vertices, mesh.normals, mesh.uvs)
    ):
        return "values that are not finite, or not one normal a vertex"
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        return f"vertex index {mesh.faces.max()} of {len(mesh.vertices)}"
    if with_uvs and (
        mesh.uv_faces.shape != mesh.faces.shape or mesh.uv_faces.min() < 0 or mesh.uv_faces.max() >= len(mesh.uvs)
    ):
        return f"{mesh.uv_faces.shape} texture indices for {mesh.faces.shape} vertex indices, {len(mesh.uvs)} uvs"
    return ""


def _bad_mesh(path: Path, value: str) -> StageError:
    return StageError(
        "the mesh can't be exported",
        where=path.name,
        value=value,
        limit="finite vertices, normals, uvs and indices within them",
        remedy="run the uv stage again",
    )


def tile_count(mesh: UvSurface) -> int:
    """Number of UDIM tiles (pipeline.tiles) of a mesh."""
    return tiles.count(Charts(mesh.uvs, mesh.uv_faces))


def on_tile(mesh: UvSurface, tile: int, count: int) -> UvSurface:
    """The triangles of one of `count` tiles, their texture coordinates in the unit square."""
    if count == 1:
        return mesh
    mine = tiles.of_face(Charts(mesh.uvs, mesh.uv_faces)) == tile
    moved = (mesh.uvs - np.array([tile, 0], np.float32)).clip(0, 1)
    return UvSurface(mesh.vertices, mesh.normals, mesh.faces[mine], moved, mesh.uv_faces[mine])


def faces_of(mesh: UvSurface) -> tuple[I32, I32, I32]:
    """The faces as they are written: their numbers of corners (P,), the corners' vertices and texture vertices (n,)."""
    if not mesh.paired:
        return np.full(len(mesh.faces), 3, np.int32), mesh.faces.ravel(), mesh.uv_faces.ravel()
    quads = meshes.whole_quads(mesh.faces, mesh.uv_faces)
    counts, corners = meshes.polygons(mesh.faces, quads)
    return counts.astype(np.int32), corners.astype(np.int32), meshes.polygons(mesh.uv_faces, quads)[1].astype(np.int32)


def charts_of(uv_faces: I32, count: int) -> I32:
    """(F,) chart of each triangle (F, 3): triangles that share a texture vertex are in one chart. count: vertices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = uv_faces[:, [0, 1]].ravel(), uv_faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(labels[uv_faces[:, 0]], np.int32)


def with_uvs_from(proxy: UvSurface, full: UvSurface, candidates: int = CANDIDATES, beyond: float = 0.0) -> UvSurface:
    """The proxy with texture coordinates of the full mesh, so that both use one material.

    Each proxy triangle is assigned to the chart nearest to its centroid, and each of its corners takes the texture
    coordinate of that chart's nearest point. So at a chart's edge corners move onto the edge, and never into another
    chart's texels. The distance combines space and texture (measured from the position that the plane of the centroid's
    triangle predicts for the corner), because a chart may meet itself at a seam.

    `beyond` (uv): corners may instead lie this far outside their chart's edge, at the position predicted by the plane
    of its triangle. A fine mesh needs this, because its triangles on a seam would lose their area. Triangles
    perpendicular to the surface they are assigned to (a rim that the full mesh does not have) are rotated into its
    plane.
    """
    from scipy.spatial import cKDTree

    chart = charts_of(full.uv_faces, len(full.uvs))
    corners, t = full.vertices[full.faces].astype(np.float64), full.uvs[full.uv_faces].astype(np.float64)
    ends = proxy.vertices[proxy.faces].astype(np.float64)
    near = cKDTree(corners.mean(1)).query(ends.mean(1), candidates, workers=-1)[1]
    hit, weights_at_centre = _nearest(ends.mean(1), corners, near)
    scale = float(np.sqrt(_areas(corners).sum() / max(_areas(t).sum(), 1e-12)))  # metres per unit of texture
    affine = _affine(corners, t)
    expected = _continued(ends, corners[hit], t[hit], weights_at_centre, affine[hit])
    places = np.concatenate([corners.mean(1), scale * t.mean(1)], 1)
    wanted = np.concatenate([ends, scale * expected], -1)
    uvs = np.zeros((len(ends), 3, 2))
    for number in np.unique(chart[hit]):
        rows, inside = np.flatnonzero(chart[hit] == number), np.flatnonzero(chart == number)
        query = wanted[rows].reshape(-1, 5)
        near = cKDTree(places[inside]).query(query, min(candidates, len(inside)), workers=-1)[1].reshape(len(query), -1)
        face, weights = _nearest(query[:, :3], corners[inside], near)
        found = (t[inside[face]] * weights[..., None]).sum(1)
        if beyond > 0:
            own = inside[face]
            plane = _continued(query[:, None, :3], corners[own], t[own], weights, affine[own])[:, 0]
            step = plane - found
            length = np.linalg.norm(step, axis=1, keepdims=True)
            found = found + step * np.minimum(1, beyond / np.maximum(length, 1e-30))
        uvs[rows] = found.reshape(-1, 3, 2)
    if beyond > 0:
        _lay_flat(uvs, ends, corners[hit], t[hit], weights_at_centre, beyond)
    home = tiles.of_face(Charts(full.uvs, full.uv_faces))[hit].astype(np.float64)
    if home.any():  # several tiles: a corner outside its own tile would show texels of another one
        uvs[..., 0] = uvs[..., 0].clip(home[:, None] + INSIDE, home[:, None] + 1 - INSIDE)
    return UvSurface(proxy.vertices, proxy.normals, proxy.faces, *_shared(uvs))


def _lay_flat(uvs: F64, ends: F64, corners: F64, t: F64, weights: F64, most: float) -> None:
    """Parameterise again triangles (N, 3, 3) whose uvs (N, 3, 2) are almost empty, mirrored or far too large. They are
    rotated into the plane of their triangle of the full mesh (`corners`, `t` (N, 3, .), `weights` (N, 3) at their
    centroid) and take its coordinates. Corners stay within `most` (uv) of the centroid. Changes uvs."""
    own, base = (np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) for x in (ends, corners))
    a, b = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    c, d = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    sign = c[:, 0] * d[:, 1] - c[:, 1] * d[:, 0]
    wanted = sign * np.linalg.norm(own, axis=1) / np.maximum(np.linalg.norm(base, axis=1), 1e-30)
    area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * np.sign(sign)
    lost = (area < AREAS[0] * np.abs(wanted)) | (area > AREAS[1] * np.abs(wanted))
    if not lost.any():
        return
    turned = _turned(ends[lost] - ends[lost].mean(1, keepdims=True), own[lost], base[lost])
    on = (corners[lost] * weights[lost][..., None]).sum(1)
    middle = (t[lost] * weights[lost][..., None]).sum(1)
    affine = _affine(corners[lost], t[lost])
    step = _continued(on[:, None] + turned, corners[lost], t[lost], weights[lost], affine) - middle[:, None]
    reach = np.linalg.norm(step, axis=2).max(1)
    uvs[lost] = middle[:, None] + step * np.minimum(1, most / np.maximum(reach, 1e-30))[:, None, None]


def _turned(points: F64, start: F64, goal: F64) -> F64:
    """(N, K, 3) points after the smallest rotation that takes direction start (N, 3) to goal (N, 3)."""
    a, b = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30) for v in (start, goal))
    half = a + b  # two reflections, at the planes perpendicular to a and to the bisector of a and b
    opposite = np.linalg.norm(half, axis=1) < 1e-6
    half[opposite] = np.cross(a[opposite], np.eye(3)[np.abs(a[opposite]).argmin(1)])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    for mirror in (a, half):
        points = points - 2 * np.einsum("nkc,nc->nk", points, mirror)[..., None] * mirror[:, None]
    return points


def half_gap(mesh: UvSurface, size: int = 1024) -> float:
    """Half of the least distance (uv) between two charts, measured on a raster of `size`, at most a texel too small;
    infinite for one chart. Texels within this distance of a chart are filled from it."""
    count = tile_count(mesh)
    return min(_half_gap(on_tile(mesh, t, count), size) for t in range(count))


def _half_gap(mesh: UvSurface, size: int) -> float:
    from pipeline import raster
    from pipeline.nearest import nearest_known

    hits = raster.rasterise(raster.texel_corners(Charts(mesh.uvs, mesh.uv_faces), size), size, 0, size, 0.5)
    chart = np.full(size * size, -1)
    chart[hits.texel] = charts_of(mesh.uv_faces, len(mesh.uvs))[hits.face]
    nearest = nearest_known((chart >= 0).reshape(size, size))
    row, column = np.divmod(nearest, size)
    y, x = np.mgrid[:size, :size]
    away = np.hypot(row - y, column - x)
    of = chart[nearest]
    least = np.inf
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        border = of[a] != of[b]
        if border.any():
            least = min(least, float((away[a] + away[b])[border].min()) / 2)
    return max(least - 1, 0.0) / size


def without_overlap(proxy: UvSurface, size: int = 1024) -> UvSurface:
    """The proxy with texture triangles shrunk towards their centroids where two cover the same texels.

    Moving corners onto a chart's edge may make neighbours overlap. Baking onto the proxy would then write texels twice.
    On a proxy a little stretch does no harm.
    """
    from pipeline import raster

    t = proxy.uvs[proxy.uv_faces].astype(np.float64)
    n = SAMPLED
    inside = np.array([[i + 1 / 3, j + 1 / 3, n - i - j + 1 / 3] for i in range(n + 1) for j in range(n + 1 - i)])
    inside /= inside.sum(1, keepdims=True)
    tile = tiles.of_face(Charts(proxy.uvs, proxy.uv_faces))
    for number in range(int(tile.max()) + 1):
        own, offset = np.flatnonzero(tile == number), np.array([number, 0])
        for _ in range(SHRINK_ROUNDS):
            local = t[own] - offset
            corners = raster.in_texels(local.astype(np.float32).astype(np.float64), size)  # as they will be written
            twice = raster.layers(corners, size) > 1
            if not twice.any():
                break
            places = np.einsum("sc,fcx->fsx", inside, local)
            column = (places[..., 0] * size).astype(int).clip(0, size - 1)
            row = ((1 - places[..., 1]) * size).astype(int).clip(0, size - 1)
            folded = own[twice[row, column].any(1)]
            t[folded] += (1 - SHRINK) * (t[folded].mean(1, keepdims=True) - t[folded])
    return UvSurface(proxy.vertices, proxy.normals, proxy.faces, *_shared(t))


def _continued(points: F64, corners: F64, t: F64, weights: F64, affine: F64) -> F64:
    """(N, K, 2) texture coordinates of points (N, K, 3) by each triangle's map `affine` (N, 3, 2)."""
    on = (corners * weights[..., None]).sum(1)
    start = (t * weights[..., None]).sum(1)
    return np.asarray(start[:, None] + (points - on[:, None]) @ affine)


def _affine(corners: F64, t: F64) -> F64:
    """(F, 3, 2) texture coordinates over space in the planes of triangles (F, 3, 3) with coordinates t (F, 3, 2)."""
    edges, along = corners[:, 1:] - corners[:, :1], t[:, 1:] - t[:, :1]
    return np.asarray(_pseudoinverse(edges) @ along)


def _pseudoinverse(edges: F64) -> F64:
    """(N, 3, 2) pseudoinverses of (N, 2, 3): E^T (E E^T)^-1. Of two edges along one line, E^T / |E|^2; of none, 0."""
    a, b = edges[:, 0], edges[:, 1]
    aa, ab, bb = ((x * y).sum(1) for x, y in ((a, a), (a, b), (b, b)))
    size, area = aa + bb, aa * bb - ab * ab
    thin = area <= LINE * size * size
    safe, length = np.where(thin, 1.0, area)[:, None], np.maximum(size, 1e-300)[:, None]
    first = np.where(thin[:, None], a / length, (bb[:, None] * a - ab[:, None] * b) / safe)
    second = np.where(thin[:, None], b / length, (aa[:, None] * b - ab[:, None] * a) / safe)
    return np.asarray(np.stack([first, second], -1))


def _areas(triangles: F64) -> F64:
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    product = np.cross(a, b) if triangles.shape[2] == 3 else (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[:, None]
    return np.asarray(np.linalg.norm(product, axis=1) / 2)


def _nearest(points: F64, corners: F64, candidates: npt.NDArray[np.integer]) -> tuple[npt.NDArray[np.int64], F64]:
    """The nearest (N,) of the candidate triangles (N, K), and barycentric weights (N, 3) of its nearest point."""
    from stages.usd.write.nearest_kernels import nearest_on_triangles

    face, weights = np.zeros(len(points), np.int64), np.zeros((len(points), 3))
    nearest_on_triangles(
        np.ascontiguousarray(points),
        np.ascontiguousarray(corners),
        np.ascontiguousarray(candidates, np.int64),
        face,
        weights,
    )
    return face, weights


def _shared(uvs: F64) -> tuple[F32, I32]:
    """The different texture coordinates (U, 2) among those of the corners (F, 3, 2), and their indices (F, 3)."""
    pairs = np.ascontiguousarray(uvs, np.float32).view(np.complex64)[..., 0]  # numpy sorts these by u, then v
    values, inverse = np.unique(pairs, return_inverse=True)
    return values.view(np.float32).reshape(-1, 2), inverse.reshape(-1, 3).astype(np.int32)


def uv_fault(proxy: UvSurface, full: UvSurface, limit: float = 0.005) -> str:
    """The fault of texture coordinates taken from the full mesh, or "".

    Faults: triangles without area, or more mirrored ones than in the full mesh (which may mirror whole charts).
    """
    empty, mirrored = _shares(proxy)
    if empty > limit:
        return f"{empty:.1%} of its surface has no area in the texture"
    wrong = abs(mirrored - _shares(full)[1])
    return f"{wrong:.1%} of its surface is mirrored in the texture" if wrong > 10 * limit else ""


def _shares(mesh: UvSurface) -> tuple[float, float]:
    """Shares of a mesh's area whose triangles have no area, and are mirrored, in the texture."""
    t = mesh.uvs[mesh.uv_faces].astype(np.float64)
    a, b = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    signed = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = _areas(mesh.vertices[mesh.faces].astype(np.float64))
    empty, mirrored = (float(area[m].sum() / max(area.sum(), 1e-30)) for m in (np.abs(signed) < 1e-10, signed < 0))
    return empty, mirrored
