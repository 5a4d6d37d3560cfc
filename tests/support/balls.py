"""Photos of a ball whose material, light and cameras are formulas: scenes for which it is known what they require."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from pipeline import transforms
from pipeline.maths import sh
from pipeline.transforms import F64
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.light_estimate import reflectance
from stages.inverse_rendering.ray_sampling import PhotoView

RADIUS, SIDE, FOCAL, DISTANCE = 0.1, 96, 170.0, 0.5


def texture(n: F64) -> F64:
    """(N, 3) albedo in about [0.2, 0.6]."""
    waves = np.stack([np.sin(9 * n[:, 0] + 2 * n[:, 1]), np.sin(8 * n[:, 1]), np.sin(7 * n[:, 2] - 3 * n[:, 0])], -1)
    return np.asarray(0.4 + 0.15 * waves, np.float64)


def nothing(n: F64, wo: F64) -> F64:
    """No lobe."""
    return np.zeros(len(n))


def alike(view: int) -> F64:
    """Every camera's gain."""
    return np.ones(3)


@dataclass(frozen=True)
class Ball:
    """diffuse(n) (N, 3) and lobe(n, wo) (N,) radiance; gain(view) (3,) of its camera; veil(view), light that a lens
    scatters over the whole photo; views around the ball."""

    lobe: Callable[[F64, F64], F64] = nothing
    gain: Callable[[int], F64] = alike
    veil: Callable[[int], float] = lambda view: 0.0
    views: int = 24

    def photos(self) -> list[PhotoView]:
        """All views, evenly around the ball and up and down."""
        return list(_photos(self))

    def photo(self, index: int) -> PhotoView:
        """A view, 2 x 2 samples a pixel."""

        def colour(n: F64, wo: F64) -> F64:
            lit = texture(n) * (0.7 + 0.3 * n[:, 1:2]) + self.lobe(n, wo)[:, None]
            return np.asarray(lit * self.gain(index) + self.veil(index))

        return ball_photo(index, self.views, colour)


def ball_photo(index: int, views: int, colour: Callable[[F64, F64], F64], turn: float = 0.0) -> PhotoView:
    """One of the views evenly around the ball and up and down, 2 x 2 samples a pixel. colour: linear (N, 3), from
    normals and the directions to the camera. turn: of the cameras, rad."""
    angle = turn + 2 * math.pi * index / views
    o = DISTANCE * np.array([math.sin(angle), 0.5 * math.sin(5 * angle), math.cos(angle)])
    z = -o / np.linalg.norm(o)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    world_from_cam = transforms.rigid(np.stack([x, np.cross(z, x), z], 1), o)
    K = np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    _, d = transforms.rays(K, world_from_cam, np.zeros(5), transforms.pixel_centres(2 * SIDE, 2 * SIDE) / 2)
    b = d @ o
    under = b * b - (o @ o - RADIUS**2)
    hit = under > 0
    n = (o + (-b - np.sqrt(np.where(hit, under, 0)))[:, None] * d)[hit] / RADIUS
    rgb = np.zeros((len(d), 3))
    rgb[hit] = colour(n, -d[hit])
    image = rgb.reshape(SIDE, 2, SIDE, 2, 3).mean((1, 3))
    alpha = hit.reshape(SIDE, 2, SIDE, 2).mean((1, 3))
    return PhotoView(index, image.astype(np.float32), alpha.astype(np.float32), K, world_from_cam, np.zeros(5))


@lru_cache(maxsize=8)
def _photos(ball: Ball) -> tuple[PhotoView, ...]:
    return tuple(ball.photo(i) for i in range(ball.views))


def gloss(band: int, strength: float = 0.1) -> Callable[[F64, F64], F64]:
    """A lobe of skin under a light of bands 0 and `band` alone: strength (1 + 0.7 Y_band,1(w_r) / max), and stronger
    towards grazing angles as rough dielectrics are."""

    def lobe(n: F64, wo: F64) -> F64:
        cosine = (n * wo).sum(1)
        mirror = 2 * cosine[:, None] * n - wo
        rim = reflectance(cosine.clip(0, 1)) / reflectance(np.ones(1))
        y = sh.sh_basis(torch.from_numpy(mirror), max(band, 1))[:, band * (band + 1) + 1].numpy()
        return np.asarray(rim * strength * (1 + 0.7 * y / math.sqrt((2 * band + 1) / (4 * math.pi))), np.float64)

    return lobe


def start(radius: float = RADIUS) -> Start:
    """The SDF of a ball around the origin."""
    lo, cell = -0.14, 0.01
    i = np.stack(np.meshgrid(*[np.arange(29)] * 3, indexing="ij"), -1)
    values = np.linalg.norm(lo + cell * i, axis=-1) - radius
    return Start(values.astype(np.float32), np.full(3, lo, np.float32), cell)
