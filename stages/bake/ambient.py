"""Ambient occlusion: share of a uniform sky that each point of the surface sees.

    ao(x) = 1 / pi integral over the hemisphere of V(x, w) max(n . w, 0) dw

V: 1 where a ray from x leaves the head, else 0. The rays are cosine-distributed, so ao is the share of them that leave.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.meshes import F32, Mesh
from pipeline.ray_casting import neighbours_first
from pipeline.visibility import LIFT, Occluder

RAYS = 96


def ambient(mesh: Mesh, occluder: Occluder, step: Callable[[int, int], None]) -> F32:
    """(V,) ambient occlusion in [0, 1] at the mesh's vertices; 1 where nothing blocks the sky."""
    order = neighbours_first(mesh.vertices)
    n = mesh.normals[order].astype(np.float64)
    across = np.cross(n, np.eye(3)[np.abs(n).argmin(1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(n, across)
    start = mesh.vertices[order] + LIFT * occluder.span * n
    free = np.zeros(len(n))
    for i in range(RAYS):
        if i % 16 == 0:
            step(i, RAYS)
        radius, turn = np.sqrt((i + 0.5) / RAYS), i * np.pi * (3 - np.sqrt(5))
        w = radius * np.cos(turn) * across + radius * np.sin(turn) * along + np.sqrt(1 - radius**2) * n
        free += ~occluder.blocks(start, w)
    out = np.empty(len(n), np.float32)
    out[order] = free / RAYS
    return out
