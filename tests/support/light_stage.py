"""A made-up light stage: a ball of known albedo, gloss and shading, photographed by analytic ray casting.

Shares no code with what is tested but the reading of directions: rays, shading and light are written out here.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.images import write_exr
from pipeline.transforms import F64, centre_K_from_corner_K, inverse_rigid, pixel_centres, rays
from tests.support.textured_ball import camera_on_orbit

RADIUS, DISTANCE = 0.1, 1.3
SIZE = 72
K = np.array([[400.0, 0, SIZE / 2], [0, 400.0, SIZE / 2], [0, 0, 1]])


@dataclass
class Stage:
    """poses: world_from_cam; lights: positions (N, 3) and intensities (N, 3)."""

    poses: list[F64]
    positions: F64
    intensities: F64


def make_stage(cameras: int = 3, lights: int = 40, seed: int = 0) -> Stage:
    """Cameras in front on an arc, lights evenly all around (a Fibonacci sphere)."""
    i = np.arange(lights) + 0.5
    up, turn = 1 - 2 * i / lights, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - up * up)
    towards = np.stack([ring * np.sin(turn), up, ring * np.cos(turn)], 1)
    strength = 4 * np.random.default_rng(seed).uniform(0.9, 1.1, (lights, 3))
    poses = [camera_on_orbit(40.0 * c - 20 * (cameras - 1), 10, 1.0, np.zeros(3)) for c in range(cameras)]
    return Stage(poses, DISTANCE * towards, strength)


def albedo_at(points: F64) -> F64:
    """(N, 3) albedo of the ball: skin-like, with broad stripes."""
    stripe = 0.5 + 0.5 * np.sin(40 * points[:, :1])
    return np.array([0.55, 0.35, 0.28]) * (0.75 + 0.25 * stripe)


def photograph(stage: Stage, camera: int, light: int, gloss: float = 0.0) -> F64:
    """(SIZE, SIZE, 3) linear picture under one light; gloss: height of a broad white highlight around the mirror
    direction."""
    origin, directions = rays(K, stage.poses[camera], np.zeros(5), pixel_centres(SIZE, SIZE))
    b = directions @ origin
    inside = b * b - (origin @ origin - RADIUS**2)
    hit = inside > 0
    points = origin + (-b - np.sqrt(np.where(hit, inside, 0)))[:, None] * directions
    normals = points / RADIUS
    away = stage.positions[light] - points
    d2 = (away**2).sum(1)
    towards = away / np.sqrt(d2)[:, None]
    faces = np.maximum((towards * (stage.positions[light] / DISTANCE)).sum(1), 0)  # the disc faces the centre
    cosine = np.maximum((normals * towards).sum(1), 0)
    half = towards - directions
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = gloss * np.maximum((half * normals).sum(1), 0) ** 60
    reflected = albedo_at(points) / np.pi + shine[:, None]
    out = reflected * (cosine * faces / d2)[:, None] * stage.intensities[light]
    return np.where(hit[:, None], out, 0).reshape(SIZE, SIZE, 3)


def write_stage(folder: Path, stage: Stage, *, gloss: float = 0.0, tracking: tuple[int, ...] = (0,)) -> Path:
    """The capture's folder in the layout of the format."""
    folder.mkdir(parents=True, exist_ok=True)
    params: dict[str, object] = {}
    for c, pose in enumerate(stage.poses):
        params |= {
            f"{c}_K": centre_K_from_corner_K(K).tolist(), f"{c}_Rt": inverse_rigid(pose)[:3].tolist(),
            f"{c}_distortion": [0.0] * 5, f"{c}_width": SIZE, f"{c}_height": SIZE, f"{c}_valid": True,
            f"{c}_sn": f"S{c}",
        }  # fmt: skip
        total = np.zeros((SIZE, SIZE, 3))
        for n in range(len(stage.positions)):
            picture = photograph(stage, c, n, gloss)
            total += picture
            write_exr(folder / "olat" / str(c) / f"{n:03d}.exr", picture.astype(np.float32), half=True)
        write_exr(folder / "full_on" / f"{c}.exr", total.astype(np.float32), half=True)
        for frame in tracking:
            write_exr(folder / "tracking" / str(c) / f"{frame:03d}.exr", total.astype(np.float32), half=True)
    (folder / "params.json").write_text(json.dumps(params))
    write_lights(folder, stage)
    return folder


def write_lights(folder: Path, stage: Stage, **changes: object) -> None:
    """lights.json; changes: of the whole file."""
    entries = [
        {"index": n, "position": p.tolist(), "direction": (p / DISTANCE).tolist(), "intensity_rgb": i.tolist(),
         "frame": n + 1}
        for n, (p, i) in enumerate(zip(stage.positions, stage.intensities, strict=True))
    ]  # fmt: skip
    (folder / "lights.json").write_text(json.dumps({"lights": entries, "stage_centre": [0, 0, 0]} | changes))
