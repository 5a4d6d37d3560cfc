"""A made-up face of 468 landmarks, and cameras before it."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts import Camera
from pipeline.faces.landmarks3d import CHIN, SIDES, TOP
from pipeline.transforms import F64, rigid, rows

SIZE = 0.18  # metres, about chin to forehead


def face() -> F64:
    """(468, 3) points on the front of an ellipsoid around the origin, +Y up, +Z to the front, symmetrical."""
    k = np.arange(468)
    angle, height = k * 2.399963, np.linspace(-1, 1, 468)
    x = np.stack([np.sqrt(1 - height**2) * np.sin(angle), height, np.abs(np.sqrt(1 - height**2) * np.cos(angle))], 1)
    for n, (right, left) in enumerate(SIDES):
        x[right] = (-0.8 + 0.05 * n, 0.4 - 0.1 * n, 0.5)
        x[left] = x[right] * (-1, 1, 1)
    x[TOP], x[CHIN] = (0, 0.95, 0.3), (0, -0.95, 0.3)
    return x * (0.4 * SIZE, 0.5 * SIZE, 0.4 * SIZE)


def camera(index: int, azimuth: float, elevation: float = 0.0, distance: float = 1.0) -> Camera:
    """Looks at the origin from somewhere in front. Angles in degrees."""
    a, e = np.radians([azimuth, elevation])
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    x = np.cross([0, 1, 0], back)
    x /= np.linalg.norm(x)
    turn = np.stack([x, -np.cross(back, x), -back], 1)
    return Camera(index=index, name=f"{index}.jpg", width=640, height=480, K=((900, 0, 320), (0, 900, 240), (0, 0, 1)),
                  world_from_cam=rows(rigid(turn, distance * back)), distortion=(-0.05, 0.01, 0, 0, 0))  # fmt: skip
