"""How large the photos' pixels are on a surface, and how large a texture's texels.

    footprint(x) = min over the views that face x of  z b / (f (n . wo))

Symbols: z depth, f focal length in pixels, b pixels along the side of a block that is taken as one. Visibility is not
tested: a hidden view can only make the median look finer, which costs texels or time, but no detail.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pipeline import meshes
from pipeline.artifacts import Camera
from pipeline.meshes import F64, Charts, Mesh
from pipeline.transforms import inverse_rigid, matrix, project

MIN_COSINE = 0.35  # flatter views smear a pixel over too much surface
MAX_POINTS = 10_000


def edges(
    points: F64, normals: F64, K: F64, world_from_cam: F64, distortion: F64, size: tuple[int, int], block: int = 1
) -> F64:
    """(N,) edge of one view's pixel at points (N, 3) with unit normals, in their unit; infinite where the view's frame
    (columns, rows) does not hold the point or it does not face the camera."""
    away = world_from_cam[:3, 3] - points
    cosine = (away * normals).sum(1) / np.linalg.norm(away, axis=1)
    uv, depth = project(K, inverse_rigid(world_from_cam), distortion, points)
    inside = (depth > 0) & (np.nan_to_num(uv, nan=-1) >= 0).all(1) & (np.nan_to_num(uv, nan=np.inf) < size).all(1)
    pixel = depth * block / float(np.sqrt(abs(np.linalg.det(K[:2, :2]))))
    return np.where(inside & (cosine > MIN_COSINE), pixel / cosine.clip(min=MIN_COSINE), np.inf)


def pixel(mesh: Mesh, cameras: Iterable[Camera]) -> float | None:
    """Median over the surface of the edge of the finest pixel that faces it, in the mesh's unit; None if none does."""
    step = max(1, -(-len(mesh.faces) // MAX_POINTS))
    faces = mesh.faces[::step]
    area = meshes.area_vectors(mesh.vertices, faces)
    weight = np.linalg.norm(area, axis=1)
    middle, normal = mesh.vertices.astype(np.float64)[faces].mean(1), area / np.maximum(weight, 1e-30)[:, None]
    best = np.full(len(faces), np.inf)
    for c in cameras:
        camera = matrix(c.K), matrix(c.world_from_cam), np.array(c.distortion)
        best = np.minimum(best, edges(middle, normal, *camera, (c.width, c.height)))
    known = np.isfinite(best)
    if not known.any():
        return None
    order = np.argsort(best[known], kind="stable")
    total = np.cumsum(weight[known][order])
    return float(best[known][order][np.searchsorted(total, 0.5 * total[-1])])


def fine_texel(mesh: Mesh, charts: Charts, size: int) -> float:
    """Edge of a texel where charts are densest: a tenth of the surface has smaller ones. As `texel` otherwise."""
    area = meshes.areas(mesh.vertices, mesh.faces)
    uv = charts.uvs.astype(np.float64)[charts.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    flat = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    edge = np.sqrt(area / np.maximum(flat, 1e-30))
    order = np.argsort(edge, kind="stable")
    total = np.cumsum(area[order])
    return float(edge[order][np.searchsorted(total, 0.1 * total[-1])]) / size


def texel(mesh: Mesh, charts: Charts, size: int) -> float:
    """Mean edge of a texel on the surface, in the mesh's unit, with `size` texels along a tile's side."""
    surface = float(meshes.areas(mesh.vertices, mesh.faces).sum())
    uv = charts.uvs.astype(np.float64)[charts.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    flat = 0.5 * float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    return float(np.sqrt(surface / max(flat, 1e-30))) / size
