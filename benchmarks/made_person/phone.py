"""Photos as a friend takes them with a phone: where from, how the head moves meanwhile, and what the phone makes of
them."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from pipeline.colour import srgb_from_linear
from pipeline.meshes import F64

SIZE, FOCAL = (640, 856), 1240.0  # pixels; a phone's second lens, about 52 mm in 35 mm terms
ARCS = ((24, 0.0, 105.0), (10, 24.0, 62.0), (9, -18.0, 62.0))  # photos, elevation and half width in degrees
NEAR, FAR = 0.66, 0.88  # metres: at the sides the wall is near
DRIFT, WHITE = 0.18, 0.03  # standard deviations of exposure (natural logarithm) and of the gains of red and blue
FALLS_OFF = 0.12  # of the light in the corners


def photos(rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """K, world-to-camera matrix and size of each, and the rigid motion of the head in it. About +Z, the face's side."""
    out: dict[str, dict[str, Any]] = {}
    sway = np.zeros(6)
    for count, elevation, half in ARCS:
        for azimuth in np.linspace(-half, half, count):
            turn, lift = np.radians([azimuth + rng.normal() * 2, elevation + rng.normal() * 3])
            away = NEAR + (FAR - NEAR) * np.cos(np.radians(azimuth) / 1.2) ** 2 + rng.normal() * 0.02
            eye = away * np.array([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)])
            aimed_at = np.array([0, -0.03, 0]) + rng.normal(size=3) * 0.012
            centre = (np.array(SIZE) - 1) / 2 + [1.2, -2.0]
            sway = 0.8 * sway + rng.normal(size=6) * [0.15, 0.2, 0.1, 0.0006, 0.0004, 0.0006]
            moved = np.eye(4)
            moved[:3, :3] = Rotation.from_rotvec(np.radians(sway[:3])).as_matrix()
            moved[:3, 3] = sway[3:]
            out[f"{len(out) + 1:04d}"] = {
                "K": [[FOCAL, 0, centre[0]], [0, FOCAL, centre[1]], [0, 0, 1]],
                "Rt": _towards(eye, aimed_at).tolist(), "size": list(SIZE), "head": moved.tolist(),
            }  # fmt: skip
    return out


def _towards(eye: F64, point: F64) -> F64:
    """(3, 4) world to camera, OpenCV axes: from `eye` to `point`, upright."""
    ahead = (point - eye) / np.linalg.norm(point - eye)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    return np.c_[R, -R @ eye]


def developed(linear: F64, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) bytes of a photo of linear radiance: exposure and white balance drift, corners are darker, a tone curve
    lifts the middle and rolls off the highlights, and the picture is sharpened."""
    h, w = linear.shape[:2]
    y, x = np.mgrid[:h, :w]
    away = ((x - w / 2) ** 2 + (y - h / 2) ** 2) / (w**2 + h**2) * 4
    gains = np.exp(rng.normal(size=3) * [WHITE, 0, WHITE] + rng.normal() * DRIFT)
    seen = linear * gains * (1 - FALLS_OFF * away)[..., None]
    seen = seen + rng.normal(size=seen.shape) * (0.003 + 0.006 * np.sqrt(seen.clip(0, 1)))
    value = np.asarray(srgb_from_linear((1.25 * seen.clip(0, None) / (1 + 0.25 * seen.clip(0, None))).clip(0, 1)))
    curved = value + 0.12 * value * (1 - value) * (2 * value - 1)
    sharp = curved + 0.5 * (curved - gaussian_filter(curved, (0.8, 0.8, 0)))
    return (255 * sharp.clip(0, 1) + 0.5).astype(np.uint8)
