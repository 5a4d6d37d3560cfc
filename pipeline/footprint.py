"""Size of the photos' pixels on a surface, and of a texture's texels.

    footprint(x) = min over the views that face x of  z b / (f (n . wo))

Symbols: z depth, f focal length in pixels, b pixels along the side of a block that counts as one pixel. Visibility is
not tested: an occluded view can only lower the median, which costs texels or time, but no detail.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pipeline import meshes
from pipeline.artifacts import Camera
from pipeline.meshes import F64, Charts, Mesh
from pipeline.transforms import inverse_rigid, matrix, project

MIN_COSINE = 0.35  # at smaller cosines a pixel covers too much surface
MAX_POINTS = 10_000


def edges(
    points: F64, normals: F64, K: F64, world_from_cam: F64, distortion: F64, size: tuple[int, int], block: int = 1
) -> F64:
    """(N,) edge of one view's pixel at points (N, 3) with unit normals (N, 3), in their unit; infinite if the point is
    outside the view's frame (columns, rows) or does not face the camera."""
    away = world_from_cam[:3, 3] - points
    cosine = (away * normals).sum(1) / np.linalg.norm(away, axis=1)
    uv, depth = project(K, inverse_rigid(world_from_cam), distortion, points)
    inside = (depth > 0) & (np.nan_to_num(uv, nan=-1) >= 0).all(1) & (np.nan_to_num(uv, nan=np.inf) < size).all(1)
    pixel = depth * block / float(np.sqrt(abs(np.linalg.det(K[:2, :2]))))
    return np.where(inside & (cosine > MIN_COSINE), pixel / cosine.clip(min=MIN_COSINE), np.inf)


def pixel(mesh: Mesh, cameras: Iterable[Camera]) -> float | None:
    """Median over the surface of the edge of the finest pixel, in the mesh's unit; None if no camera sees it."""
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
    """As `texel`, but the 10th percentile over the surface: the edge of a texel in the finest charts."""
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
