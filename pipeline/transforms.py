"""The only module that converts frames and pixel conventions and projects through cameras.

Symbols: `<to>_from_<from>` matrices act on column vectors. Cameras have OpenCV axes (x right, y down, z forward).
Image positions `uv` are in pixels from the image's corner: the first pixel's centre is (0.5, 0.5).
Distortion d = (k1, k2, p1, p2, k3) of OpenCV's model; depth_z is along the optical axis, ray_t along the ray.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
UNDISTORT_STEPS, UNDISTORT_TOLERANCE = 50, 1e-12

USD_CAM_FROM_OPENCV_CAM: F64 = np.diag([1.0, -1.0, -1.0, 1.0])  # USD cameras look along -z with +y up
OPENCV_CAM_FROM_OPENGL_CAM: F64 = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's (NeRF's) look along -z with +y up too


def matrix(rows: object) -> F64:
    """A float64 array from a manifest's nested tuples."""
    return np.array(rows, np.float64)


def rows(array: npt.NDArray[np.generic]) -> tuple[tuple[float, ...], ...]:
    """A manifest's nested tuples from an array."""
    return tuple(tuple(float(x) for x in r) for r in np.asarray(array, np.float64))


def corner_K_from_centre_K(K: F64) -> F64:
    """Intrinsics with the first pixel's centre at (0.5, 0.5), from those with it at (0, 0) (FaceScape, OpenCV)."""
    out = np.array(K, np.float64)
    out[:2, 2] += 0.5
    return out


def centre_K_from_corner_K(K: F64) -> F64:
    """Inverse of `corner_K_from_centre_K`."""
    out = np.array(K, np.float64)
    out[:2, 2] -= 0.5
    return out


def rigid(rotation: F64, translation: F64) -> F64:
    """4x4 from a 3x3 rotation and a (3,) translation."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out


def inverse_rigid(m: F64) -> F64:
    """Inverse of a 4x4 rigid motion, without a general solve."""
    return rigid(m[:3, :3].T, -m[:3, :3].T @ m[:3, 3])


def similarity(scale: float, rotation: F64, translation: F64) -> F64:
    """4x4 of x -> scale * rotation @ x + translation."""
    return rigid(scale * rotation, translation)


def scale_of(m: F64) -> float:
    """The scale of a similarity (4, 4), or of its upper left part (3, 3)."""
    return float(np.cbrt(np.linalg.det(m[:3, :3])))


def umeyama(source: F64, target: F64) -> F64:
    """4x4 similarity with the least squared distance from source (N, 3) to target (N, 3) [Umeyama 1991]; its scale is 0
    if the source is one point."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, values, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float((values * signs).sum() / max(float((a * a).sum()), 1e-300))
    return similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def rescale_camera(to_from_world: F64, world_from_cam: F64) -> F64:
    """A camera's rigid 4x4 pose after a similarity of its world (the scale moves the centre, not the axes)."""
    scale = scale_of(to_from_world)
    turned = to_from_world[:3, :3] / scale @ world_from_cam[:3, :3]
    return rigid(turned, to_from_world[:3, :3] @ world_from_cam[:3, 3] + to_from_world[:3, 3])


def apply(m: F64, points: npt.NDArray[np.floating]) -> F64:
    """(N, 3) points (N, 3) transformed by a 4x4 affine matrix."""
    out: F64 = np.asarray(points, np.float64) @ m[:3, :3].T + m[:3, 3]
    return out


def distort(xy: F64, d: F64) -> F64:
    """(N, 2) positions (N, 2) on the z = 1 plane after lens distortion d."""
    k1, k2, p1, p2, k3 = d
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def distortion_slope(xy: F64, d: F64) -> tuple[F64, F64, F64]:
    """a, b, c (N,) of the symmetric Jacobian [[a, b], [b, c]] of `distort` at xy (N, 2)."""
    k1, k2, p1, p2, k3 = d
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))  # d radial / d x = slope * x
    a = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    b = slope * x * y + 2 * p1 * x + 2 * p2 * y
    c = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return a, b, c


def undistort(xy: F64, d: F64) -> F64:
    """Exact inverse of `distort` by Newton's method with the analytic Jacobian. (N, 2) -> (N, 2)."""
    if not np.any(d):
        return xy.copy()
    out = xy.copy()
    for _ in range(UNDISTORT_STEPS):
        error = distort(out, d) - xy
        a, b, c = distortion_slope(out, d)
        determinant = a * c - b * b
        step = np.stack([c * error[:, 0] - b * error[:, 1], a * error[:, 1] - b * error[:, 0]], -1)
        out -= step / np.where(np.abs(determinant) > 1e-9, determinant, 1.0)[:, None]
        if np.abs(error).max(initial=0) < UNDISTORT_TOLERANCE:
            break
    return out


def project(K: F64, cam_from_world: F64, distortion: F64, points: npt.NDArray[np.floating]) -> tuple[F64, F64]:
    """Image positions (N, 2) and depth_z (N,) of world points (N, 3). Behind the camera (depth_z <= 0) uv is NaN."""
    p = apply(cam_from_world, points)
    z = p[:, 2]
    safe = np.where(z > 1e-9, z, np.nan)
    xy = distort(p[:, :2] / safe[:, None], distortion) if np.any(distortion) else p[:, :2] / safe[:, None]
    return xy @ K[:2, :2].T + K[:2, 2], z


def projection_slope(K: F64, cam_from_world: F64, distortion: F64, points: npt.NDArray[np.floating]) -> F64:
    """(N, 2, 3) derivative of `project`'s image position by the world point, at points (N, 3) before the camera."""
    p = apply(cam_from_world, points)
    z = p[:, 2]
    xy = p[:, :2] / z[:, None]
    a, b, c = distortion_slope(xy, distortion)
    lens = K[:2, :2] @ np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)  # (N, 2, 2), d uv / d xy
    out = np.empty((len(p), 2, 3))
    out[..., :2] = lens / z[:, None, None]
    out[..., 2] = -np.einsum("nij,nj->ni", lens, xy) / z[:, None]
    return np.asarray(out @ cam_from_world[:3, :3], np.float64)


def rays(K: F64, world_from_cam: F64, distortion: F64, uv: F64) -> tuple[F64, F64]:
    """Origin (3,) and unit directions (N, 3), in the world, through image positions uv (N, 2)."""
    inverse, u, v = np.linalg.inv(K[:2, :2]), uv[:, 0] - K[0, 2], uv[:, 1] - K[1, 2]
    x, y = (
        row[0] * u + row[1] * v for row in inverse
    )  # by columns, because BLAS is slow for products of 2 x 2 and (2, N)
    if np.any(distortion):
        x, y = undistort(np.stack([x, y], -1), distortion).T
    length = np.sqrt(x * x + y * y + 1)
    x, y, z = x / length, y / length, 1 / length
    directions = np.stack([row[0] * x + row[1] * y + row[2] * z for row in world_from_cam[:3, :3]], -1)
    return world_from_cam[:3, 3].copy(), directions


def pixel_centres(width: int, height: int, step: int = 1) -> F64:
    """(H * W, 2) image positions of pixel centres, row by row; with `step`, of the centres of step x step blocks."""
    u = (np.arange(width // step) + 0.5) * step
    v = (np.arange(height // step) + 0.5) * step
    grid = np.stack(np.meshgrid(u, v), -1)
    return grid.reshape(-1, 2)
