"""The scene that every machine can make: a textured ball, seen from all around. Speed is measured on it, so that the
figures need no capture and compare between machines."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from stages.inverse_rendering.config import Config
    from stages.inverse_rendering.fit import Trainer
    from stages.inverse_rendering.initial_geometry import Start
    from stages.inverse_rendering.ray_sampling import PhotoView

RADIUS, HALF, DISTANCE = 0.1, 0.14, 0.5
WHOLE: dict[str, Any] = {"rank": 3, "light_order": 10, "specular": "on", "refine_geometry": "on", "calibration": "on"}


def ball_view(index: int, count: int, side: int) -> PhotoView:
    """A photo of a ball with waves of colour, one sample a pixel."""
    from pipeline import transforms
    from stages.inverse_rendering.ray_sampling import PhotoView

    angle = 2 * math.pi * index / count
    o = DISTANCE * np.array([math.sin(angle), 0.5 * math.sin(5 * angle), math.cos(angle)])
    z = -o / np.linalg.norm(o)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    world_from_cam = transforms.rigid(np.stack([x, np.cross(z, x), z], 1), o)
    f = 1.9 * side
    K = np.array([[f, 0, side / 2], [0, f, side / 2], [0, 0, 1]])
    _, d = transforms.rays(K, world_from_cam, np.zeros(5), transforms.pixel_centres(side, side))
    b = d @ o
    under = b * b - (o @ o - RADIUS**2)
    hit = under > 0
    n = (o + (-b - np.sqrt(np.where(hit, under, 0)))[:, None] * d) / RADIUS
    rgb = np.where(hit[:, None], 0.3 + 0.15 * np.sin(40 * n), 0).astype(np.float32)
    shape = (side, side)
    alpha = hit.astype(np.float32).reshape(shape)
    return PhotoView(index, rgb.reshape(*shape, 3), alpha, K, world_from_cam, np.zeros(5))


def ball_start(cells: int) -> Start:
    """The SDF of the ball on a grid with so many cells a side."""
    from stages.inverse_rendering.initial_geometry import Start

    axis = np.linspace(-HALF, HALF, cells + 1, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    values = np.sqrt(x * x + y * y + z * z) - RADIUS
    return Start(np.asarray(values, np.float32), np.full(3, -HALF, np.float32), 2 * HALF / cells)


def ball_trainer(views: int, side: int, cells: int, settings: Config, device: str) -> Trainer:
    """A fit of the ball on one grid, about to begin and far from its end."""
    from stages.inverse_rendering.initialise import new_trainer

    endless = settings.changed(steps=1_000_000, seconds=0.0, levels=1, image_side=side, shadows=False)
    photos = [ball_view(i, views, side) for i in range(views)]
    t = new_trainer(photos, ball_start(cells), endless, settings.calibration == "on", device)
    t.enter_level()
    return t
