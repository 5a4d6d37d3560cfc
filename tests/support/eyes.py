"""A made-up eye behind a slit, photographed: ball, iris, pupil and a lamp's reflection that moves, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.eyes.ball import Eye
from pipeline.images import write_png_from_linear
from pipeline.meshes import Mesh
from pipeline.transforms import matrix, rays
from pipeline.visibility import FittedPhoto, Occluder
from tests.support.faces import camera

WHITE, IRIS, PUPIL, LIDS = (0.6, 0.55, 0.5), (0.15, 0.1, 0.06), (0.02, 0.02, 0.02), (0.4, 0.25, 0.2)
SLIT = 0.0055  # metres: half the height of the opening


def gaze_to(left: float, up: float) -> np.ndarray:
    """Unit direction from angles in degrees to the person's left and up."""
    a, b = np.radians([left, up])
    return np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])


def slit(eye: Eye, half: float = SLIT) -> Mesh:
    """Two sheets before the ball that leave an opening from left to right: half of its height, metres."""
    z = eye.centre[2] + eye.radius + 5e-4
    corners, faces = [], []
    for low, high in ((half, 0.05), (-0.05, -half)):
        at = 4 * len(corners) // 4
        corners += [(x, y, z) for x, y in ((-0.05, low), (0.05, low), (0.05, high), (-0.05, high))]
        faces += [(at, at + 1, at + 2), (at, at + 2, at + 3)]
    points = np.array(corners) + [eye.centre[0], eye.centre[1], 0]
    return Mesh(points.astype(np.float32), np.tile(np.float32([0, 0, 1]), (8, 1)), np.array(faces, np.int32))


def colours(eye: Eye, directions: np.ndarray) -> np.ndarray:
    """(N, 3) of the ball in unit directions (N, 3) of the world."""
    angle = np.arccos(np.clip(directions @ eye.axes[2], -1, 1))
    limbus = np.arcsin(eye.iris / eye.radius)
    out = np.where((angle < limbus)[:, None], IRIS, WHITE)
    return np.where((angle < 0.4 * limbus)[:, None], PUPIL, out)


def photographed(
    eye: Eye, folder: Path, views: Sequence[tuple[float, float]], *, distance: float = 0.3, half: float = SLIT
) -> list[FittedPhoto]:
    """Photos from azimuths and elevations in degrees."""
    out, lids = [], Occluder(slit(eye, half))
    for i, (azimuth, elevation) in enumerate(views):
        one = camera(i, azimuth, elevation, distance)
        x, y = np.meshgrid(np.arange(one.width) + 0.5, np.arange(one.height) + 0.5)
        origin, ways = rays(matrix(one.K), matrix(one.world_from_cam), np.array(one.distortion),
                            np.stack([x.ravel(), y.ravel()], -1))  # fmt: skip
        along = (ways * (eye.centre - origin)).sum(1)
        off = np.linalg.norm(origin + along[:, None] * ways - eye.centre, axis=1)
        hit = off < eye.radius
        far = along - np.sqrt(np.maximum(eye.radius**2 - off**2, 0))
        toward = (origin + far[:, None] * ways - eye.centre) / eye.radius
        image = np.where(hit[:, None], colours(eye, toward), LIDS)
        shiny = hit & (np.linalg.norm(toward - (ways * -1 + [0.3, 0.3, 1]) / np.linalg.norm(
            ways * -1 + [0.3, 0.3, 1], axis=1, keepdims=True), axis=1) < 0.06)  # fmt: skip
        image[shiny] = 1.0
        image[lids.distance(origin, ways) < far] = LIDS
        path = folder / f"eye_{i}.png"
        write_png_from_linear(path, image.reshape(one.height, one.width, 3).astype(np.float32))
        out.append(FittedPhoto(one, None, path))
    return out
