"""Quadric decimation (pipeline.decimation), and repair of the faults that it leaves.

A bubble is removed by cutting the mesh along crowded edges and keeping the largest part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.decimation import is_crowded, largest_parts, simplified, unit_box
from pipeline.errors import StageError
from pipeline.meshes import F64, Faces, Indices, Mesh, split_apart

AGGRESSIVENESS = (5.0, 3.0, 7.0, 2.0)  # tried in turn until the result is a manifold of the target size
LOOP = 8  # edges of the largest hole that is closed
ROUNDS = 4  # of removing bubbles
SAMPLE_SEED = 0
NEAR = 12  # nearest points, and nearest centroids, of the other mesh: the distance to their triangles is computed
SPREAD = 10  # points on the other mesh for each sample
NEARLY = 1.05  # of the target: near enough to stop trying


def decimated(dense: Mesh, target: int) -> Mesh:
    """A manifold with about `target` triangles and smooth normals. It is closed if the dense mesh is closed and any
    setting gives a closed one. A mesh that is small enough is returned as it is.

    Normals are copied from the nearest dense vertex: they come from the field's gradient, which is more accurate than
    the faces.

    Raises:
        StageError: no setting gives a manifold.
    """
    if len(dense.faces) <= target:
        return dense
    closed = meshes.topology(dense.faces, len(dense.vertices)).watertight
    points, scale, origin = unit_box(dense.vertices)
    best: tuple[F64, Faces] | None = None
    opened: tuple[F64, Faces] | None = None
    for aggressiveness in AGGRESSIVENESS:
        vertices, faces = simplified(points, dense.faces, target, aggressiveness)
        vertices, faces = split_apart(*without_bubbles(vertices, faces))
        if closed:  # after the removal of bubbles, holes with a simple border are left
            faces = filled(faces)
        found = meshes.topology(faces, len(vertices))
        if not (found.manifold if closed else found.sound):
            if opened is None and found.sound:
                opened = vertices, faces
            continue
        if best is None or len(faces) < len(best[1]):
            best = vertices, faces
        if len(faces) <= NEARLY * target:
            break
    best = opened if best is None else best
    if best is not None:
        v = (best[0] / scale + origin).astype(np.float32)
        return Mesh(v, normals_from(dense, v, best[1]), best[1])
    raise StageError(
        "the mesh can't be decimated",
        where="uv.target_faces",
        value=f"from {len(dense.faces)} to {target} faces the surface breaks",
        limit="at most two faces at every edge, one fan of faces around every vertex",
        remedy="raise uv.target_faces, or change surface.resolution",
    )


def without_bubbles(vertices: F64, faces: Faces) -> tuple[F64, Faces]:
    """Cut along crowded edges and keep of each piece the part with most faces, until none is crowded. Inputs (V, 3),
    (F, 3)."""
    for _ in range(ROUNDS):
        if not is_crowded(faces, len(vertices)):
            break
        faces = filled(largest_parts(faces, len(vertices)))
    v, f, _ = meshes.compact(vertices, faces)
    return np.asarray(v, np.float64), f


def filled(faces: Faces) -> Faces:
    """Faces (F', 3) with holes of up to LOOP edges closed by fans: the ring around a bubble may be a hole."""
    open_edges = meshes.open_edges(faces, int(faces.max()) + 1)
    after = {int(b): int(a) for a, b in open_edges}  # a hole's border is opposite to its neighbours' edges
    added = []
    while after:
        start, at = next(iter(after.items()))
        loop = [start]
        del after[start]
        while at in after and len(loop) <= LOOP:
            loop.append(at)
            at = after.pop(at)
        if at == start and 3 <= len(loop) <= LOOP:
            added += [(loop[0], loop[i], loop[i + 1]) for i in range(1, len(loop) - 1)]
    return np.concatenate([faces, np.array(added, np.int32)]) if added else faces


def normals_from(dense: Mesh, vertices: npt.NDArray[np.float32], faces: Faces) -> npt.NDArray[np.float32]:
    """(V, 3) unit normals of the nearest dense vertex; the faces' own where both differ by over 60 degrees."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(dense.vertices).query(vertices, workers=1)
    own = meshes.vertex_normals(vertices, faces)
    found = dense.normals[nearest]
    agree = (own * found).sum(1) > 0.5
    return np.where(agree[:, None], found, own).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Deviation:
    """Distances between two surfaces, sampled by area in both directions, in the meshes' unit."""

    mean: float
    rms: float


def deviation(a: Mesh, b: Mesh, samples: int = 20_000) -> Deviation:
    """Distance between two meshes. It is exact for the candidate triangles, so it can only be too large: large
    triangles are found by points spread over them, small ones by their centroids."""
    d = np.concatenate([one_way(a, b, samples), one_way(b, a, samples)])
    return Deviation(float(d.mean()), float(np.sqrt((d * d).mean())))


def one_way(start: Mesh, goal: Mesh, samples: int) -> F64:
    """(samples,) distances from points of one mesh to another."""
    from scipy.spatial import cKDTree

    points, _ = sampled(start, samples)
    corners = goal.vertices.astype(np.float64)[goal.faces]
    on, face = sampled(goal, SPREAD * samples)
    _, under = cKDTree(on).query(points, k=NEAR)
    _, beside = cKDTree(corners.mean(1)).query(points, k=min(NEAR, len(corners)))
    near = np.concatenate([face[under], np.asarray(beside).reshape(len(points), -1)], 1)
    best = np.full(len(points), np.inf)
    for column in near.T:
        best = np.minimum(best, distance_to_triangles(points, corners[column]))
    return best


def distance_to_triangles(p: F64, corners: F64) -> F64:
    """(N,) distance from each point (N, 3) to its own triangle (N, 3, 3)."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal * normal).sum(1), 1e-300)
    inside = np.ones(len(p), np.bool_)
    best = np.full(len(p), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        side, offset = end - start, p - start
        inside &= (np.cross(side, offset) * normal).sum(1) >= 0
        t = ((offset * side).sum(1) / np.maximum((side * side).sum(1), 1e-300)).clip(0, 1)
        best = np.minimum(best, np.linalg.norm(offset - t[:, None] * side, axis=1))
    plane = np.abs(((p - a) * normal).sum(1)) / np.sqrt(square)
    return np.where(inside, plane, best)


def sampled(mesh: Mesh, count: int) -> tuple[F64, Indices]:
    """(count, 3) points on the mesh, uniform by area and deterministic, and the face (count,) of each."""
    rng = np.random.default_rng(SAMPLE_SEED)
    area = meshes.areas(mesh.vertices, mesh.faces)
    face = np.searchsorted(np.cumsum(area) / area.sum(), rng.random(count)).clip(0, len(area) - 1)
    r, s = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    a, b, c = mesh.vertices.astype(np.float64)[mesh.faces[face]].transpose(1, 0, 2)
    out: F64 = (1 - r) * a + r * (1 - s) * b + r * s * c
    return out, np.asarray(face, np.int64)


def flipped_share(dense: Mesh, mesh: Mesh) -> float:
    """Share of the area whose faces point against the nearest dense normal."""
    from scipy.spatial import cKDTree

    centre = mesh.vertices[mesh.faces].mean(1)
    _, nearest = cKDTree(dense.vertices).query(centre)
    vectors = meshes.area_vectors(mesh.vertices, mesh.faces)
    against = (vectors * dense.normals[nearest]).sum(1) < 0
    area = np.linalg.norm(vectors, axis=1)
    return float(area[against].sum() / area.sum())
