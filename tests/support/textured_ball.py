"""A ball with a solid noise texture, photographed by analytic ray casting: photos with exactly known cameras."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from pipeline.transforms import F64, centre_K_from_corner_K, inverse_rigid, pixel_centres, rays, rigid


def camera_on_orbit(azimuth: float, elevation: float, distance: float, target: F64) -> F64:
    """4x4 world_from_cam, OpenCV axes, looking at `target`, upright. Angles in degrees; azimuth 0 is on +Z."""
    a, e = np.radians([azimuth, elevation])
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.cross(back * -1, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return rigid(np.stack([right, np.cross(-back, right), -back], 1), target + distance * back)


def photograph(world_from_cam: F64, K: F64, size: tuple[int, int], radius: float = 0.1) -> np.ndarray:
    """(H, W, 3) uint8 of a ball around the origin. K: first pixel's centre at (0.5, 0.5)."""
    origin, directions = rays(K, world_from_cam, np.zeros(5), pixel_centres(*size))
    b = directions @ origin
    inside = b * b - (origin @ origin - radius**2)
    hit = inside > 0
    points = origin + (-b - np.sqrt(np.where(hit, inside, 0)))[:, None] * directions
    noise = np.random.default_rng(5)
    value = np.zeros((len(points), 3))
    for cells, weight in ((9, 0.5), (25, 0.5)):
        grid = noise.random((cells, cells, cells, 3))
        at = (points / radius + 1) / 2 * (cells - 1)
        for c in range(3):
            value[:, c] += weight * map_coordinates(grid[..., c], at.T, order=1, mode="nearest")
    value[~hit] = 0
    return np.round(value.clip(0, 1) * 255).astype(np.uint8).reshape(size[1], size[0], 3)


def write_facescape(folder: Path, poses: list[F64], K: F64, size: tuple[int, int], *, pictures: bool = True) -> dict:
    """Photos 0.jpg ... and params.json in FaceScape's convention (first pixel's centre at 0)."""
    folder.mkdir(parents=True, exist_ok=True)
    params: dict[str, object] = {}
    for i, pose in enumerate(poses):
        picture = photograph(pose, K, size) if pictures else flat(size, i)
        cv2.imwrite(str(folder / f"{i}.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        params |= {
            f"{i}_K": centre_K_from_corner_K(K).tolist(), f"{i}_Rt": inverse_rigid(pose)[:3].tolist(),
            f"{i}_distortion": [0.0] * 5, f"{i}_width": size[0], f"{i}_height": size[1], f"{i}_valid": True,
            f"{i}_sn": f"B{i}", f"{i}_ori": f"{i}.jpg", f"{i}_matches": 1000,
        }  # fmt: skip
    (folder / "params.json").write_text(json.dumps(params))
    return params


def flat(size: tuple[int, int], seed: int) -> np.ndarray:
    """A cheap picture, different for each seed: (H, W, 3) uint8."""
    ramp = np.add.outer(np.arange(size[1]), np.arange(size[0])) + 17 * seed
    return np.repeat((ramp % 251).astype(np.uint8)[..., None], 3, 2)
