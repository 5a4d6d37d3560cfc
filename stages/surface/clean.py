"""From the result of marching cubes to one component with outward faces and vertices on the zero set.

Symbols: h lattice cell; d SDF; g its gradient. A vertex lies either on the zero set of the SDF or on the cap, which is
the surface where the field's box or the subject's extent cuts the solid. Vertices move only along their own gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import meshes
from pipeline.fields.protocol import Field
from pipeline.meshes import F32, F64, Faces, Mask
from stages.surface.extract import QUERY, Lattice, wall_distance
from stages.surface.pieces import Votes, chosen

NEWTON_STEPS = 3
REACH = 0.5  # of h: a vertex is never further from its position on the surface
THIN = 1e-4  # of h^2: a face with a smaller area is degenerate
RELAX_STEPS = 10


@dataclass(frozen=True, slots=True)
class Landed:
    """Vertices on the surface (V, 3), their outward unit normals (V, 3), and a mask of those on the cap (V,)."""

    vertices: F64
    normals: F32
    capped: Mask


@dataclass(frozen=True, slots=True)
class Kept:
    """The component that is kept. removed: number of the others; second: area of the largest of them over that of the
    kept one; unshown: share of the visible surface that is on them."""

    vertices: F64
    faces: Faces
    removed: int
    second: float
    unshown: float


def one_piece(vertices: F64, faces: Faces, vote: Votes | None = None) -> Kept:
    """Keep the connected component that the photos show most of, by their votes (stages.surface.pieces); without votes
    the one with the largest area. vertices (V, 3), faces (F, 3).

    Faces belong together if they share a vertex. Cavities (components that face inwards) are dropped like specks; only
    components that face outwards count for `second`.
    """
    label = meshes.component_of_face(faces, len(vertices))
    label = np.asarray(np.unique(label, return_inverse=True)[1].reshape(-1), np.int64)
    vectors = meshes.area_vectors(vertices, faces)
    area = np.asarray(np.bincount(label, np.linalg.norm(vectors, axis=1)), np.float64)
    solid = np.bincount(label, (vertices[faces[:, 0]] * vectors).sum(1)) > 0
    first, unshown = int(area.argmax()), 0.0
    if vote is not None:
        first, unshown = chosen(vertices, faces, label, area, solid, vote)
    v, f, _ = meshes.compact(vertices, faces[label == first])
    others = np.where(solid, area, 0.0)
    others[first] = 0.0
    return Kept(np.asarray(v, np.float64), f, int((area > 0).sum()) - 1, float(others.max() / area[first]), unshown)


def land(field: Field, grid: Lattice, start: F64, steps: int = NEWTON_STEPS) -> Landed:
    """Project points (V, 3) onto the surface: Newton's method along the gradient, at most REACH * h from the start.

    x <- x - d g / |g|^2
    """
    x = start.copy()
    value, gradient, capped = _solid(field, grid, x)
    for _ in range(steps):
        square = (gradient * gradient).sum(1)
        x = x - (value / np.maximum(square, 1e-6))[:, None] * gradient
        moved = x - start
        length = np.linalg.norm(moved, axis=1)
        x = start + moved * np.minimum(1, REACH * grid.h / np.maximum(length, 1e-30))[:, None]
        value, gradient, capped = _solid(field, grid, x)
    return Landed(x, meshes.unit(gradient).astype(np.float32), capped)


def spread_degenerate(field: Field, grid: Lattice, landed: Landed, faces: Faces) -> Landed:
    """Move the corners of degenerate faces towards the mean of their neighbours, and project them again.

    Deleting such faces could open the mesh or make it non-manifold; moving their corners keeps the topology.
    """
    x = landed.vertices.copy()
    e = meshes.edges(faces)
    degree = np.bincount(e[:, 0], minlength=len(x))
    for _ in range(RELAX_STEPS):
        thin = meshes.areas(x.astype(np.float32), faces) < THIN * grid.h**2
        if not thin.any():
            return landed
        corners = np.unique(faces[thin])
        sums = np.stack([np.bincount(e[:, 0], x[e[:, 1], i], len(x)) for i in range(3)], 1)
        middle = sums[corners] / degree[corners, None]
        again = land(field, grid, 0.5 * (x[corners] + middle), 2)
        x[corners] = again.vertices
        normals, capped = landed.normals.copy(), landed.capped.copy()
        normals[corners], capped[corners] = again.normals, again.capped
        landed = Landed(x.copy(), normals, capped)
    return landed


def outward(vertices: F64, faces: Faces) -> Faces:
    """Faces (F, 3) with outward normals: all are flipped if the mesh encloses a negative volume."""
    return faces if meshes.volume(vertices, faces) >= 0 else np.ascontiguousarray(faces[:, ::-1])


def _solid(field: Field, grid: Lattice, points: F64) -> tuple[F64, F64, Mask]:
    """The SDF (N,) cut by the walls (see extract.cut), its gradient (N, 3), and where the wall is the larger (N,)."""
    value, gradient = np.empty(len(points)), np.empty((len(points), 3))
    for start in range(0, len(points), QUERY):
        part = slice(start, start + QUERY)
        inside = np.clip(points[part], grid.lower, grid.upper).astype(np.float32)
        value[part], gradient[part] = field.sdf_and_gradient(inside)
    wall, wall_gradient = wall_distance(points, grid)
    capped = (wall > value) & (wall > -grid.h)
    return np.where(capped, wall, value), np.where(capped[:, None], wall_gradient, gradient), capped
