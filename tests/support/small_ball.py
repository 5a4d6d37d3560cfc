"""A ball, half red half blue, with a fit of it in seconds: photos, start, settings, trainer."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipeline import transforms
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.training_loop import Hooks, run_fit

RADIUS, SIDE = 0.1, 64
SMALL = Config(
    lr_sdf=0.2,  # few steps for 8 mm
    image_side=64,
    steps=200,
    batch=512,
    samples=8,
    grid_cells=48,
    levels=2,
    hash_levels=6,
    hash_log2_size=12,
    hash_fine=0.004,
    width=32,
)


def ball_view(index: int, gain: float = 1.0) -> PhotoView:
    """A photo of a ball, half red half blue, under a light that falls off from +y: closed form by hand."""
    angle = 2 * math.pi * index / 12
    centre = 0.5 * np.array([math.sin(angle), 0.4 * math.sin(3 * angle), math.cos(angle)])
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    world_from_cam = transforms.rigid(np.stack([x, np.cross(z, x), z], 1), centre)
    K = np.array([[90.0, 0, SIDE / 2], [0, 90.0, SIDE / 2], [0, 0, 1]])
    uv = transforms.pixel_centres(SIDE * 4, SIDE * 4) / 4  # 4 x 4 samples a pixel
    o, d = transforms.rays(K, world_from_cam, np.zeros(5), uv)
    b = d @ o
    under = b * b - (o @ o - RADIUS**2)
    hit = under > 0
    p = o + (-b - np.sqrt(np.where(hit, under, 0)))[:, None] * d
    n = p / RADIUS
    albedo = np.where(n[:, :1] > 0, [[0.6, 0.3, 0.3]], [[0.25, 0.3, 0.6]])
    rgb = np.where(hit[:, None], gain * albedo * (0.7 + 0.3 * n[:, 1:2]), 0)
    image = rgb.reshape(SIDE, 4, SIDE, 4, 3).mean((1, 3))
    alpha = hit.reshape(SIDE, 4, SIDE, 4).mean((1, 3))
    return PhotoView(index, image.astype(np.float32), alpha.astype(np.float32), K, world_from_cam, np.zeros(5))


def ball_start(radius: float = 0.108) -> Start:
    lo, cell = -0.14, 0.01
    i = np.stack(np.meshgrid(*[np.arange(29)] * 3, indexing="ij"), -1)
    values = np.linalg.norm(lo + cell * i, axis=-1) - radius
    return Start(values.astype(np.float32), np.full(3, lo, np.float32), cell)


def trainer(
    settings: Config = SMALL, calibrated: bool = False, gains: Callable[[int], float] = lambda i: 1.0
) -> Trainer:
    views = [ball_view(i, gains(i)) for i in range(12) if i != 5]
    return new_trainer(views, ball_start(), settings, calibrated, "cpu")


def hooks(path: Path | None = None, stop: Callable[[], bool] = lambda: False) -> Hooks:
    return Hooks(lambda *a, **k: None, stop, path)


def fit_of_the_ball(_: Path) -> Trainer:
    t = trainer()
    run_fit(t, hooks())
    return t
