"""Pictures of the template: rays against its triangles, smooth normals, one light from above and the sky.

Used to look at regions and layout, and to show the face network something like a person. Lengths in any unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.meshes import F64, Faces, Indices, vertex_normals

U8 = npt.NDArray[np.uint8]
EMBREE_SIZE = 100.0  # embree has absolute tolerances
KEY, FILL = np.array([0.35, 0.55, 0.75]), 0.45


@dataclass(frozen=True, slots=True)
class Shot:
    """A camera with OpenCV axes: K (3, 3), world_from_cam (4, 4), pixels along each side."""

    K: F64
    world_from_cam: F64
    size: int


@dataclass(frozen=True, slots=True)
class Seen:
    """What each pixel that shows the mesh sees: pixel (n,), triangle (n,), weights (n, 3), position, normal (n, 3)."""

    pixel: Indices
    triangle: Indices
    weights: F64
    position: F64
    normal: F64


def orbit(centre: F64, radius: float, azimuth: float, elevation: float, size: int) -> Shot:
    """A camera that frames a sphere from so many degrees to the person's left, and above."""
    a, e = np.radians([azimuth, elevation])
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, -np.cross(back, right), -back], 1)
    pose[:3, 3] = centre + 6 * radius * back
    focal = 0.5 * size / np.tan(np.arcsin(1 / 6))
    return Shot(np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), pose, size)


def traced(vertices: F64, triangles: Faces, shot: Shot) -> Seen:
    """The nearest triangle of each pixel."""
    y, x = np.mgrid[: shot.size, : shot.size] + 0.5
    toward = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ np.linalg.inv(shot.K).T
    toward = toward @ shot.world_from_cam[:3, :3].T
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    triangle, weights = hit(vertices, triangles, np.broadcast_to(shot.world_from_cam[:3, 3], toward.shape), toward)
    pixel = np.flatnonzero(triangle >= 0)
    face, w = triangles[triangle[pixel]], weights[pixel]
    normals = vertex_normals(vertices, triangles).astype(np.float64)
    normal = (normals[face] * w[..., None]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Seen(pixel, triangle[pixel], w, (vertices[face] * w[..., None]).sum(1), normal)


def hit(vertices: F64, triangles: Faces, origins: F64, directions: F64) -> tuple[Indices, F64]:
    """(n,) the triangle that each ray meets first, -1 for none, and its barycentric weights (n, 3) there."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scale = EMBREE_SIZE / float(np.ptp(vertices, axis=0).max())
    scene = EmbreeScene()
    mesh = TriangleMesh(scene, (vertices * scale).astype(np.float32), triangles.astype(np.int32))
    found = scene.run(
        np.ascontiguousarray(origins * scale, np.float32), np.ascontiguousarray(directions, np.float32), output=True
    )
    del mesh
    u, v = found["u"].astype(np.float64), found["v"].astype(np.float64)
    return found["primID"].astype(np.int64), np.stack([1 - u - v, u, v], 1)


def shaded(seen: Seen, colour: F64, shot: Shot, background: float = 0.55) -> U8:
    """(size, size, 3) sRGB of linear colours (n, 3) of what is seen, lit from the front's upper left."""
    key = KEY / np.linalg.norm(KEY)
    light = FILL * (0.75 + 0.25 * seen.normal[:, 1]) + 0.7 * np.maximum(seen.normal @ key, 0)
    out = np.full((shot.size * shot.size, 3), background)
    out[seen.pixel] = colour * light[:, None]
    srgb = np.where(out <= 0.0031308, 12.92 * out, 1.055 * np.clip(out, 0.0031308, 1) ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(srgb * 255 + 0.5, 0, 255).astype(np.uint8).reshape(shot.size, shot.size, 3), np.uint8)


def checker(uv: F64, cells: int = 32) -> F64:
    """(n, 3) a chequered colour for texture coordinates (n, 2); columns and rows turn red and green."""
    odd = (np.floor(uv * cells).sum(1) % 2)[:, None]
    tint = np.stack([0.25 + 0.5 * (uv[:, 0] % 1), 0.25 + 0.5 * uv[:, 1], np.full(len(uv), 0.35)], 1)
    return np.asarray(tint * (0.35 + 0.65 * odd), np.float64)


def side_by_side(pictures: list[U8]) -> U8:
    """One row."""
    return np.concatenate(pictures, 1)
