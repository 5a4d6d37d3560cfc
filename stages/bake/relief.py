"""Maps of the shape that artists build masks from: curvature, cavity and thickness, at the mesh's vertices.

Symbols: x_i, n_i positions and unit normals (of the SDF) at a triangle's corners, N its unit normal, A its area, e_i
the edge opposite to corner i, counterclockwise.

    grad phi_i = N x e_i / (2 A)                     of the linear function that is 1 at corner i
    H          = 1/2 sum_i n_i . grad phi_i          mean curvature of a triangle: half the divergence of the normals
                                                     in its plane [Meyer 2003: H = div(n) / 2]; 1 / r on a ball

H of a vertex is the mean of its triangles by area, smoothed over FINE. It is positive where the surface is convex. It
needs no neighbours beyond a border, so that an open mesh and a single triangle have it too.

    cavity    = 1/2 + 1/2 u / sqrt(1 + u^2),    u = CAVITY (H over FINE - H over COARSE)

So the form of the head drops out: a plane and a ball of any size have 1/2. A wave of length L in the surface keeps
G(FINE) - G(COARSE) of its curvature, G(w) = (1 + (pi w / L)^2)^-2 (pipeline/smoothing.py).

    thickness = mean over RAYS of min(distance to the head's own surface, FAR)

for rays from x into the head, cosine-distributed about -n in a cone with the half angle CONE. A slab of thickness d has
2 d / (1 + cos CONE) = 1.17 d, a ball of radius r 4 r (1 - c^3) / (3 (1 - c^2)), c = cos CONE: 1.72 r. A ray that leaves
an open mesh counts as FAR.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.meshes import F32, F64, Mesh, area_vectors
from pipeline.ray_casting import neighbours_first
from pipeline.smoothing import Smoother
from pipeline.tangents import any_across
from pipeline.visibility import Occluder

FINE, COARSE = 0.001, 0.008  # metres: standard deviations of the two smoothings
CAVITY = 0.006  # metres: a crease of mean curvature -1 / 6 mm has cavity .15
RAYS, CONE, FAR = 32, np.pi / 4, 0.1  # per vertex; half angle; metres
LIFT = 1e-5  # of the head's size: rays start this far below the surface; 5 micrometres on a head
SMALLEST = 1e-14  # m^2: the area of a triangle without a plane


@dataclass(frozen=True, slots=True)
class Relief:
    """At the vertices (V,): mean curvature (1/m), cavity in [0, 1], thickness (m)."""

    curvature: F32
    cavity: F32
    thickness: F32


def relief(mesh: Mesh, normals: F64, occluder: Occluder, step: Callable[[int, int], None]) -> Relief:
    """All of them. normals (V, 3): unit, of the field at the vertices."""
    raw = mean_curvature(mesh, normals)
    fine, coarse = (Smoother(mesh, width)(raw[:, None])[:, 0] for width in (FINE, COARSE))
    return Relief(
        fine.astype(np.float32),
        cavity(fine, coarse).astype(np.float32),
        thickness(mesh.vertices.astype(np.float64), normals, occluder, step).astype(np.float32),
    )


def mean_curvature(mesh: Mesh, normals: F64) -> F64:
    """(V,) H in 1/m, not smoothed; 0 at a vertex without a triangle. normals (V, 3)."""
    x = mesh.vertices.astype(np.float64)[mesh.faces]
    vector = area_vectors(mesh.vertices, mesh.faces)
    area = np.linalg.norm(vector, axis=1)
    whole = area > SMALLEST
    n = normals[mesh.faces]
    total = np.zeros(len(area))
    for i in range(3):
        edge = x[:, (i + 2) % 3] - x[:, (i + 1) % 3]
        total += (n[:, i] * np.cross(vector, edge)).sum(1)  # 2 A^2 times the divergence
    triangle = np.where(whole, total / np.maximum(2 * area, SMALLEST), 0.0)  # A times the divergence
    count = len(mesh.vertices)
    above, below = (np.bincount(mesh.faces.ravel(), np.repeat(v, 3), count) for v in (triangle, area * whole))
    return np.asarray(0.5 * above / np.maximum(below, SMALLEST))


def cavity(fine: F64, coarse: F64) -> F64:
    """(V,) in [0, 1]: below 1/2 concave, above convex. fine, coarse (V,): mean curvature (1/m) over both lengths."""
    u = CAVITY * (fine - coarse)
    return np.asarray(0.5 + 0.5 * u / np.sqrt(1 + u * u))


def thickness(points: F64, normals: F64, occluder: Occluder, step: Callable[[int, int], None]) -> F64:
    """(N,) metres, at points (N, 3) with outward unit normals (N, 3)."""
    order = neighbours_first(points)
    points, normals = points[order], normals[order]
    across = any_across(normals)
    along = np.cross(normals, across)
    lift = LIFT * occluder.span
    start = points - lift * normals
    total = np.zeros(len(points))
    for i in range(RAYS):
        if i % 16 == 0:
            step(i, RAYS)
        radius, turn = np.sin(CONE) * np.sqrt((i + 0.5) / RAYS), i * np.pi * (3 - np.sqrt(5))
        down = np.sqrt(1 - radius**2)
        w = radius * np.cos(turn) * across + radius * np.sin(turn) * along - down * normals
        total += np.minimum(occluder.distances(start, w) + lift / down, FAR)
    out = np.empty(len(points))
    out[order] = total / RAYS
    return out
