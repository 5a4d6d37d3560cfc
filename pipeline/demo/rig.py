"""Cameras of the demo capture: rows on a sphere about the head, most of them in front and at the sides.

World frame: metres, +Y up, +Z out of the face. Camera frame: OpenCV. Pixel centres at integers.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.demo.render import Camera

F64 = npt.NDArray[np.float64]

TARGET = np.array([0.0, -0.026, 0.005])
"""The point that the cameras look at, with random offsets of some centimetres."""

FIELD = 0.325
"""Height of the world that a picture shows at the target's distance, metres."""

# Elevation in degrees, share of the views, and half the range of azimuths in degrees.
_ROWS = (
    (-24.0, 0.18, 112.0),
    (-5.0, 0.25, 120.0),
    (13.0, 0.25, 120.0),
    (32.0, 0.17, 112.0),
    (54.0, 0.08, 90.0),
)
_BACK = (150.0, -145.0, 179.0)  # azimuths, repeated, of the views that are left over


def rig_cameras(views: int, size: int, seed: int) -> list[Camera]:
    """`views` cameras of `size` x `size` pixels, ordered by row, jittered by `seed`."""
    rng = np.random.default_rng((seed, 7))
    cameras = []
    for azimuth, elevation in _angles(views):
        jitter = rng.uniform(-1.0, 1.0, 6)
        distance = 1.0 + 0.05 * jitter[0]
        angles = (azimuth + 2.5 * jitter[1], elevation + 2.5 * jitter[2])
        target = TARGET + 0.004 * jitter[3:]
        cameras.append(Camera(_intrinsics(size), _look_at(target, *angles, distance), size))
    return cameras


def _angles(views: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of every view, degrees; azimuth 0 is in front, 90 on the head's left."""
    counts = [round(share * views) for _, share, _ in _ROWS]
    while sum(counts) > views:
        counts[int(np.argmax(counts))] -= 1
    out: list[tuple[float, float]] = []
    for (elevation, _, reach), count in zip(_ROWS, counts, strict=True):
        # Middles of equal parts: even two views of a row then stand in front, not at its two ends.
        steps = ((np.arange(count) + 0.5) / max(count, 1) * 2.0 - 1.0) * reach
        out += [(float(a), elevation) for a in steps]
    left = views - len(out)
    return out + [(_BACK[i % len(_BACK)], 8.0 + 22.0 * (i % 2)) for i in range(left)]


def _intrinsics(size: int) -> F64:
    focal = size / FIELD  # pixels, for a camera one metre away
    middle = (size - 1) / 2.0
    return np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])


def _look_at(target: F64, azimuth: float, elevation: float, distance: float) -> F64:
    """World-to-camera (3, 4) of an upright camera that looks at `target`; angles in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.cross((0.0, 1.0, 0.0), back)
    right /= np.linalg.norm(right)
    down = -np.cross(back, right)
    cam_from_world = np.stack([right, down, -back])
    position = target + distance * back
    return np.concatenate([cam_from_world, -(cam_from_world @ position)[:, None]], axis=1)
