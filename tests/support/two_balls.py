"""A made-up bust, two balls, seen by a ring of cameras of which some cut it off at the neck."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera

F32 = npt.NDArray[np.float32]
HEAD, TORSO = ((0.0, 0.02, 0.0), 0.09), ((0.0, -0.14, 0.0), 0.12)
WIDTH, FOCAL, AWAY = 160, 400.0, 1.0
BOTTOM = 100  # rows from here on show the torso alone


def camera_at(angle: float, up: float, index: int, rows: int = WIDTH) -> Camera:
    """A camera that looks at the origin from an angle about the vertical; rows: of its frame, from the top."""
    centre = AWAY * np.array([np.cos(up) * np.sin(angle), np.sin(up), np.cos(up) * np.cos(angle)])
    z = -centre / AWAY
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1), centre
    K = ((FOCAL, 0.0, WIDTH / 2), (0.0, FOCAL, WIDTH / 2), (0.0, 0.0, 1.0))
    world_from_cam = tuple(tuple(float(v) for v in r) for r in pose)
    return Camera(index=index, name=f"{index}.png", width=WIDTH, height=rows, K=K, world_from_cam=world_from_cam,
                  distortion=(0.0,) * 5)  # fmt: skip


def ring_camera(index: int, count: int, rows: int = WIDTH) -> Camera:
    """One of a ring of cameras that look at the origin, in turn from a little above and below."""
    return camera_at(2 * np.pi * index / count, 0.15 * (-1) ** index, index, rows)


def bust_alpha(c: Camera) -> F32:
    """Alpha of head and torso."""
    return balls_alpha(c, (HEAD, TORSO))


def balls_alpha(c: Camera, balls: tuple[tuple[tuple[float, float, float], float], ...]) -> F32:
    """Alpha of balls (centre, radius), by the angle between a pixel's ray and the way to a ball's centre."""
    pose = np.array(c.world_from_cam)
    v, u = np.mgrid[: c.height, : c.width] + 0.5
    ray = np.stack([(u - WIDTH / 2) / FOCAL, (v - WIDTH / 2) / FOCAL, np.ones_like(u)], -1) @ pose[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    out = np.zeros((c.height, c.width), bool)
    for middle, radius in balls:
        way = np.array(middle) - pose[:3, 3]
        along = ray @ way
        out |= way @ way - along**2 < radius**2
    return out.astype(np.float32)


def cropped_bust() -> tuple[list[Camera], list[F32]]:
    """24 cameras all around that cut the torso off at the neck, then 26 in front within 20 degrees and one at the side
    (the last) that show it: no other view limits how deep the torso is."""
    around = [ring_camera(i, 24, BOTTOM) for i in range(24)]
    front = [camera_at(a, 0.1 * (-1) ** i, 24 + i) for i, a in enumerate(np.radians(np.linspace(-20, 20, 26)))]
    cameras = [*around, *front, camera_at(np.pi / 2, 0.0, 50)]
    return cameras, [bust_alpha(c) for c in cameras]
