"""A sphere as an exported asset, and where rays meet a sphere analytically."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from support.synthetic_asset import RADIUS, ball

from pipeline.camera import PinholeCamera
from stages.usd.render.exported import ExportedAsset
from stages.usd.write.mesh import UvSurface


@lru_cache(maxsize=1)
def fine_ball() -> UvSurface:
    """Fine enough that interpolated normals are the sphere's to 1e-4."""
    mesh = ball(192, 96, height=1.0)
    return UvSurface(*(mesh[k] for k in ("vertices", "normals", "faces", "uvs", "uv_faces")))


def asset(**changes: object) -> ExportedAsset:
    """A fine sphere, grey, without specular reflection, under a constant light of radiance 1."""
    light = np.zeros((121, 3), np.float32)
    light[0] = np.sqrt(4 * np.pi)
    parts: dict[str, object] = {
        "mesh": fine_ball(),
        "albedo": np.full((8, 8, 3), 0.4, np.float32),
        "coefficients": np.zeros((8, 8, 1), np.float32),
        "inv_kappa": np.full((8, 8, 1), 1e-6, np.float32),
        "normal": None,
        "basis": np.ones((16, 1), np.float32),
        "light": light,
        "attenuation": "exact",
    }
    return ExportedAsset(**(parts | changes))  # type: ignore[arg-type]


def sphere_points(view: PinholeCamera, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals (size, size, 3), wo, and which pixels lie well inside, by intersecting a sphere analytically."""
    pixel = np.arange(size) + 0.5
    x, y = np.meshgrid((pixel - view.K[0, 2]) / view.K[0, 0], (pixel - view.K[1, 2]) / view.K[1, 1])
    d = np.stack([x, y, np.ones_like(x)], -1) @ view.world_from_cam[:3, :3].T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = view.world_from_cam[:3, 3]
    b = d @ o
    root = b * b - (o @ o - RADIUS**2)
    hit = root > 0.2 * RADIUS**2
    points = o + (-b - np.sqrt(root.clip(0)))[..., None] * d
    return points / RADIUS, -d, hit
