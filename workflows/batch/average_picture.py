"""A picture of the average head: from the front, from three quarters and from the side, with its mean albedo.

`view` shows any textured mesh so: an even light from two sides, no specular part, no shadows.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.images import write_png_from_linear
from pipeline.meshes import F32, F64, unit
from pipeline.ray_casting import RayCaster

SIDE = 480  # pixels of each view
SAMPLES = 2  # rays along each side of a pixel
VIEWS = (0.0, 40.0, 90.0)  # degrees about +Y
TOWARDS = unit(np.array([[0.5, 0.6, 0.9], [-0.9, 0.2, 0.4]]))  # directions of two lights
STRENGTHS, AMBIENT = (0.75, 0.3), 0.35
BACKGROUND = 0.05


def picture(path: Path, mesh: Any, albedo: Mapping[int, F32]) -> None:
    """Write the PNG. mesh: stages.usd.write.mesh.UvSurface, metres, +Y up, +Z out of the face; albedo: linear, by
    tile."""
    caster = RayCaster(mesh.vertices, mesh.faces)
    views = [view(mesh, albedo, caster, np.radians(d), SIDE) for d in VIEWS]
    write_png_from_linear(path, np.concatenate(views, 1))


def view(mesh: Any, albedo: Mapping[int, F32], caster: RayCaster, angle: float, side: int) -> F32:
    """(side, side, 3) linear; parallel rays, from `angle` (radians from +Z towards +X)."""
    low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
    middle, half = 0.5 * (low + high), 0.54 * float((high - low).max())
    out = np.array([np.sin(angle), 0.0, np.cos(angle)])  # towards the viewer
    right = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    at = (np.arange(side * SAMPLES) + 0.5) / (side * SAMPLES) * 2 - 1
    x, y = np.meshgrid(at * half, -at * half)
    origins = middle + 3 * half * out + x.reshape(-1, 1) * right + y.reshape(-1, 1) * np.array([0.0, 1.0, 0.0])
    far, face = caster.hits(origins, np.broadcast_to(-out, origins.shape))
    colour = np.full((len(origins), 3), BACKGROUND)
    hit = np.flatnonzero(face >= 0)
    colour[hit] = _shaded(mesh, albedo, origins[hit] - far[hit, None] * out, face[hit])
    return np.asarray(colour.reshape(side, SAMPLES, side, SAMPLES, 3).mean((1, 3)).clip(0, 1), np.float32)


def _shaded(mesh: Any, albedo: Mapping[int, F32], points: F64, face: Any) -> F64:
    weight = _barycentric(mesh.vertices.astype(np.float64)[mesh.faces[face]], points)[..., None]
    normal = unit((mesh.normals[mesh.faces[face]] * weight).sum(1))
    u, v = (mesh.uvs[mesh.uv_faces[face]] * weight).sum(1).T
    tile = np.clip(np.floor(mesh.uvs[mesh.uv_faces[face]].mean(1)[:, 0]), 0, max(albedo)).astype(int)
    base = np.zeros((len(face), 3))
    for number, picture_of in albedo.items():
        own, size = tile == number, len(picture_of)
        column, row = ((u[own] - number) * size).astype(int), ((1 - v[own]) * size).astype(int)
        base[own] = picture_of[row.clip(0, size - 1), column.clip(0, size - 1)]
    light = AMBIENT + sum(s * np.clip(normal @ d, 0, None) for s, d in zip(STRENGTHS, TOWARDS, strict=True))
    return np.asarray(base * light[:, None], np.float64)


def _barycentric(corners: F64, points: F64) -> F64:
    """(N, 3) weights of the corners (N, 3, 3) at points (N, 3) in their planes."""
    a, b, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    normal = np.cross(a, b)
    area = np.maximum((normal * normal).sum(1), 1e-30)
    second, third = (np.cross(p, b) * normal).sum(1) / area, (np.cross(a, p) * normal).sum(1) / area
    return np.stack([1 - second - third, second, third], 1).clip(0, 1)
