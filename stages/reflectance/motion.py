"""How the head moved: a rigid pose for each tracking picture, and a smooth path between them.

    minimise  sum rho( I_f(project(T x)) - I_0(project(x)) )  over the rigid motion T

Symbols
    x        points of the surface that a camera sees, at rest
    I_0      picture under all lights at rest, I_f the tracking picture; square roots of luminance
    T        x -> R (x - p) + p + t; p the points' centre
Gauss-Newton steps with Cauchy weights. Between the pictures the six numbers follow a cubic spline through them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.images import F32
from pipeline.maths.rigid_motion import rotation, rotation_vector
from pipeline.transforms import F64, inverse_rigid, matrix, project

STEPS, SCALE, BLUR = 6, 0.02, 0.7
FARTHEST = 0.02  # asset units (metres): a head that moved more has turned to other lights and cameras
FEWEST = 200  # points


def prepared(picture: F32, gain: float) -> F64:
    """(H, W) square root of the mean colour, slightly blurred: errors then count alike in light and shadow."""
    import cv2

    grey = np.sqrt(np.maximum(picture.mean(2).astype(np.float64) * gain, 0))
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), BLUR), np.float64)


def pose_between(
    seen: Sequence[F64], cameras: Sequence[Camera], before: Sequence[F64], after: Sequence[F64], pivot: F64
) -> F64:
    """(6,) the motion between two pictures of each camera, `prepared`. seen: for each camera the points (N, 3) that it
    shows, at rest. Zero where the pictures do not determine it."""
    six = np.zeros(6)
    for _ in range(STEPS):
        system, right = np.zeros((6, 6)), np.zeros(6)
        for points, camera, first, second in zip(seen, cameras, before, after, strict=True):
            a, b = _normal_equations(points, camera, first, second, six, pivot)
            system += a
            right += b
        if np.linalg.cond(system) > 1e12:
            return np.zeros(6)
        step = -np.linalg.solve(system, right)
        turn = rotation(step[:3]) @ rotation(six[:3])
        six = np.concatenate([rotation_vector(turn), six[3:] + step[3:]])
    return six


def _normal_equations(points: F64, camera: Camera, before: F64, after: F64, six: F64, pivot: F64) -> tuple[F64, F64]:
    cam_from_world = inverse_rigid(matrix(camera.world_from_cam))
    K, lens = matrix(camera.K), np.array(camera.distortion)
    arm = (points - pivot) @ rotation(six[:3]).T
    uv0, _ = project(K, cam_from_world, lens, points)
    uv1, _ = project(K, cam_from_world, lens, arm + pivot + six[3:])
    local = (arm + pivot + six[3:]) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    down, right = (np.asarray(g, np.float64) for g in np.gradient(after))
    gx, gy = _at(right, uv1) * K[0, 0] / local[:, 2], _at(down, uv1) * K[1, 1] / local[:, 2]
    slope = np.stack([gx, gy, -(gx * local[:, 0] + gy * local[:, 1]) / local[:, 2]], 1) @ cam_from_world[:3, :3]
    row = np.concatenate([np.cross(arm, slope), slope], 1)
    error = _at(after, uv1) - _at(before, uv0)
    weight = 1 / (1 + (error / SCALE) ** 2)
    weighted = row * weight[:, None]
    return weighted.T @ row, weighted.T @ error


def _at(picture: F64, uv: F64) -> F64:
    """(N,) bilinear values at positions (N, 2), pixels from the corner."""
    from scipy.ndimage import map_coordinates

    return np.asarray(map_coordinates(picture, (uv - 0.5).T[::-1], order=1, mode="nearest"), np.float64)


def path(poses: Mapping[int, F64], frames: Sequence[int]) -> dict[int, F64]:
    """(6,) at each frame: a cubic spline through the poses by frame, constant outside. One pose: it everywhere."""
    from scipy.interpolate import CubicSpline

    known = sorted(poses)
    values = np.stack([poses[f] for f in known])
    if len(known) == 1:
        return dict.fromkeys(frames, values[0])
    curve = CubicSpline(known, values) if len(known) > 2 else _line(known, values)
    return {f: np.asarray(curve(np.clip(f, known[0], known[-1])), np.float64) for f in frames}


def _line(known: Sequence[int], values: F64) -> Callable[[float], F64]:
    return lambda f: values[0] + (values[1] - values[0]) * (f - known[0]) / (known[1] - known[0])


def checked(poses: Mapping[int, F64]) -> None:
    """Raises StageError if the head moved too far for one field."""
    for frame, six in sorted(poses.items()):
        far = float(np.linalg.norm(six[3:]))
        if far > FARTHEST:
            raise StageError(
                "the head moved too far during the sequence",
                where=f"tracking pictures of frame {frame}",
                value=f"{1000 * far:.0f} mm",
                limit=f"{1000 * FARTHEST:.0f} mm",
                remedy="fix the head by a headrest and take the sequence again, or remove the pictures from this frame "
                "on",
            )
