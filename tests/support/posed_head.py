"""The demo's head as a photo and as a model that shows it: for registration, with motions that are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from pipeline.demo import head, light
from pipeline.demo.mesh import Mesh, mesh_from_distance
from pipeline.demo.render import Camera, Scene, render, scene_from_mesh
from pipeline.maths.rigid_motion import camera_of_moved
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, inverse_rigid, pixel_centres, rays, rigid
from stages.inverse_rendering.registration import SQUARE, Pair
from stages.inverse_rendering.registration_outline import outline_of

SIZE, FOCAL, DISTANCE = 192, 560.0, 0.75
K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])


@cache
def _mesh() -> Mesh:
    return mesh_from_distance(head.signed_distance, head.distance_and_gradient, head.BOUNDS, 0.003)


@cache
def _scene() -> Scene:
    return scene_from_mesh(_mesh(), light.studio_coefficients(0.52), 16, 0)


def pose_at(azimuth: float) -> F64:
    """4x4 world_from_cam at an azimuth in degrees, looking at the middle of the head."""
    a = np.radians(azimuth)
    back = np.array([np.sin(a), 0.1, np.cos(a)])
    back /= np.linalg.norm(back)
    x = np.cross(-back, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return rigid(np.stack([x, np.cross(-back, x), -back], 1), DISTANCE * back)


def photographed(pose: F64, stream: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """sRGB-encoded brightness (h, w) and alpha (h, w)."""
    centre = K.copy()
    centre[:2, 2] -= 0.5  # the demo's renderer counts from the centre of the first pixel
    picture = render(_scene(), Camera(centre, inverse_rigid(pose)[:3], SIZE), stream)
    c = picture.radiance.clip(0, 1)
    encoded = np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
    return encoded.mean(-1).astype(np.float32), picture.alpha.astype(np.float32)


def pair(azimuth: float, motion: F64, noise: float = 0.005, *, outline: bool = True) -> Pair:
    """A photo of the head after `motion` (6,), and what a model shows of the head at rest."""
    pose = pose_at(azimuth)
    photo, alpha = photographed(camera_of_moved(pose, motion), 1)
    photo = photo + noise * np.random.default_rng(1).standard_normal(photo.shape).astype(np.float32)
    model, opacity = photographed(pose, 2)
    origin, directions = rays(K, pose, np.zeros(5), pixel_centres(SIZE, SIZE))
    mesh = _mesh()
    caster = RayCaster(mesh.vertices.astype(np.float64), mesh.faces)
    away = caster.distances(np.broadcast_to(origin, directions.shape), directions).reshape(SIZE, SIZE)
    x = np.full((SIZE, SIZE, 3), np.nan)
    hit = np.isfinite(away)
    x[hit] = origin + away[hit][:, None] * directions.reshape(SIZE, SIZE, 3)[hit]
    depth = np.where(hit, away, 0).astype(np.float32)
    jump = cv2.dilate(depth, np.ones((3, 3))) - cv2.erode(depth, np.ones((3, 3)))
    surface = hit & (jump < 0.008) & (opacity > 0.99)
    found = Pair(
        photo.astype(np.float32), model, x, surface & (alpha > 0.99), K, inverse_rigid(pose), np.zeros(5), 1
    )  # fmt: skip
    if not outline:
        return found
    every = np.ones((SIZE, SIZE), np.bool_)
    return replace(found, outline=outline_of(found, alpha, opacity, x, surface, every, SQUARE))
